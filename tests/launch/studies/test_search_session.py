"""Rungs continue the best candidates from their checkpoints; a killed search ends as any other."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_lines import failed, output

from headway.contracts.errors import HeadwayError
from headway.store.atomic_files import locked
from headway.store.index import RunIndex
from headway.store.parquet_log import read_rows
from headway_launch.experiments.options import own_configs
from headway_launch.experiments.search import read_search
from headway_launch.runner.runner import EXIT_DONE, EXIT_STOPPED, Runner
from headway_launch.studies import search_session
from headway_launch.studies.search_results import presets_of, results_of, write_preset
from headway_launch.studies.search_session import Candidate, SearchSession
from headway_launch.studies.trials import Trials

pytest.importorskip("optuna", reason='Optuna is not installed: pip install "headway[search]"')

SEARCH = """
base: [env=trivial, backend=serial, energy=off, rollout.copies=2, rollout.block=2, rollout.steps=16,
       evaluation.every=32, evaluation.episodes=1, evaluation.final_episodes=1]
algorithms: {ippo: [], ia2c: []}
candidates: 4
batch: 2
env_steps: 128
rungs: [64]
space:
  algo.lr: {low: 1.0e-4, high: 1.0e-1, log: true}
"""
States = dict[str, list[tuple[Any, ...]]]
Opened = Callable[..., SearchSession]


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Opened:
    """Open a session of `SEARCH` with overrides, in a folder of this name."""
    (tmp_path / "search").mkdir()
    (tmp_path / "search" / "small.yaml").write_text(SEARCH)

    def open_session(folder: str, *overrides: str) -> SearchSession:
        (tmp_path / folder).mkdir(exist_ok=True)
        monkeypatch.chdir(tmp_path / folder)
        with own_configs(str(tmp_path)):
            return SearchSession(read_search("small", overrides))

    return open_session


def states(session: SearchSession) -> States:
    return {
        part.label: [
            (each.trial.number, dict(each.trial.values), dict(each.trial.scores), each.trial.state)
            for each in session.candidates(part)
        ]
        for part in session.parts
    }


class Untrained:
    """In place of training: scores that are functions of values and steps, and a record of calls."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.trained: list[tuple[str, int, int]] = []
        self.failing: set[tuple[str, int]] = set()
        patch.setattr(SearchSession, "_train", lambda _, left, steps, debug: self.train(left, steps))
        patch.setattr(SearchSession, "_scores", lambda _, left, steps: self.scores(left, steps))

    def train(self, candidates: Sequence[Candidate], env_steps: int) -> int:
        self.trained += [(each.part.label, each.trial.number, env_steps) for each in candidates]
        return EXIT_DONE

    def scores(self, candidates: Sequence[Candidate], env_steps: int) -> dict[tuple[str, int], float]:
        names = {(each.part.label, each.trial.number): each for each in candidates}
        return {
            name: float(each.trial.values["algo.lr"]) * env_steps
            for name, each in names.items()
            if name not in self.failing
        }


@pytest.fixture
def untrained(monkeypatch: pytest.MonkeyPatch) -> Untrained:
    return Untrained(monkeypatch)


def test_the_best_of_each_batch_are_continued(opened: Opened, untrained: Untrained) -> None:
    session = opened("runs")
    assert session.run() == EXIT_DONE
    for label, candidates in states(session).items():
        lr = [values["algo.lr"] for _, values, _, _ in candidates]
        for pair in ((0, 1), (2, 3)):
            best = max(pair, key=lr.__getitem__)
            for number in pair:
                state = "COMPLETE" if number == best else "PRUNED"
                ends = (64, 128) if number == best else (64,)
                assert candidates[number][2:] == ({end: lr[number] * end for end in ends}, state)
                assert [steps for name, n, steps in untrained.trained if (name, n) == (label, number)] == [
                    *ends
                ]


@pytest.mark.parametrize("sampler", ["random", "tpe"])
@pytest.mark.usefixtures("untrained")
def test_a_search_killed_anywhere_ends_as_one_that_was_not(
    sampler: str, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    unkilled = opened("whole", f"sampler={sampler}")
    assert unkilled.run() == EXIT_DONE
    writes = {name: getattr(Trials, name) for name in ("draw", "report", "end")}
    for place in (1, 5, 14):
        count = 0

        def killed(*arguments: object, name: str, place: int = place) -> object:
            nonlocal count
            count += 1
            if count == place + 1:
                raise KeyboardInterrupt
            return writes[name](*arguments)

        with monkeypatch.context() as patch:
            for name in writes:
                patch.setattr(Trials, name, lambda *arguments, name=name: killed(*arguments, name=name))
            with pytest.raises(KeyboardInterrupt):
                opened(f"killed {place}", f"sampler={sampler}").run()
        again = opened(f"killed {place}", f"sampler={sampler}")
        assert again.run() == EXIT_DONE
        assert states(again) == states(unkilled)


def test_failed_candidates_leave_the_search_unless_all_fail(opened: Opened, untrained: Untrained) -> None:
    """After a second try."""
    untrained.failing = {("ippo", 0), ("ippo", 2), ("ippo", 3)}
    session = opened("runs")
    assert session.run() == EXIT_DONE
    assert [state for *_, state in states(session)["ippo"]] == ["FAIL", "COMPLETE", "FAIL", "FAIL"]
    tries = [number for label, number, _ in untrained.trained if label == "ippo"]
    assert [tries.count(number) for number in range(4)] == [2, 2, 2, 2]
    trained = len(untrained.trained)
    assert opened("runs").run() == EXIT_DONE
    assert len(untrained.trained) == trained
    untrained.failing |= {(label, number) for label in ("ippo", "ia2c") for number in range(4)}
    with pytest.raises(HeadwayError, match="all candidates of batch 1 of 2 have failed"):
        opened("others").run()
    untrained.failing = set()
    assert opened("others").run() == EXIT_DONE


def test_results_have_the_best_and_its_preset(opened: Opened, untrained: Untrained, tmp_path: Path) -> None:
    """Failed candidates count as the worst; what the experiment sets over any preset is named."""
    untrained.failing = {("ippo", 1)}
    session = opened("runs", "algo.gamma=0.5")
    assert session.run() == EXIT_DONE
    ippo, ia2c = results = results_of(session)
    assert ippo.best is not None
    assert ippo.best is ippo.ranked[0]
    scores = [each.trial.score for each in ippo.ranked]
    assert ippo.expected_best is not None
    assert ippo.expected_best.mean[0] == pytest.approx(np.mean([*scores, min(scores)]))
    assert ia2c.unscored == 0
    path = session.database.parent / "preset" / "found.yaml"
    presets = presets_of(results, "found")
    assert presets == {"found": {"ippo": ippo, "ia2c": ia2c}}
    assert write_preset(presets["found"], path, "small") == []
    lr = ippo.best.trial.values["algo.lr"]
    rollout = {"copies": 2, "block": 2, "steps": 16}
    assert yaml.safe_load(path.read_text())["ippo"] == {"rollout": rollout, "algo": {"gamma": 0.5, "lr": lr}}
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "ours.yaml").write_text("env: trivial\nalgo: {lr: 0.5}\n")
    text = (tmp_path / "search" / "small.yaml").read_text()
    (tmp_path / "search" / "small.yaml").write_text(text.replace("env=trivial", "experiment=ours"))
    session = opened("others")
    assert session.run() == EXIT_DONE
    with own_configs(str(tmp_path)):
        found = presets_of(results_of(session), "found")["found"]
        notes = write_preset(found, tmp_path / "preset" / "found.yaml", "small")
    assert len(notes) == 2
    assert notes[0].startswith("ippo: the experiment sets algo.lr over any preset; add algo.lr=")


def test_labels_of_one_algorithm_have_a_preset_each(
    opened: Opened, untrained: Untrained, tmp_path: Path
) -> None:
    """The common one has the better of them."""
    (tmp_path / "search" / "two.yaml").write_text(
        SEARCH.replace("ippo: []", "ippo: [], one step: [algo=ippo, algo.gamma=0.0]")
    )
    untrained.failing = {("ippo", 0)}
    opened("runs")
    shown = output("search", "two", "--config-dir", str(tmp_path)).err
    found = {path.stem: yaml.safe_load(path.read_text()) for path in (tmp_path / "preset").iterdir()}
    assert set(found) == {"search_two", "search_two_ippo", "search_two_one-step"}
    assert found["search_two"]["ippo"] == found["search_two_one-step"]["ippo"]
    assert found["search_two"]["ippo"]["algo"]["gamma"] == 0.0
    assert "gamma" not in found["search_two_ippo"]["ippo"]["algo"]
    assert "search_two.yaml (one step, ia2c); use it with: " in shown
    assert "search_two_ippo.yaml (ippo); use it with: " in shown
    assert "env=trivial preset=search_two_ippo algo=ippo seed=0..9" in shown


def test_notices_before_training_are_printed_once(
    opened: Opened, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = SEARCH.replace("ippo: [], ia2c: []", "ippo: [start.rule=optimal, start.env_steps=32]")
    (tmp_path / "search" / "small.yaml").write_text(text)
    opened("runs")
    monkeypatch.setattr(Runner, "run", lambda *_, report: EXIT_DONE)
    shown = failed("search", "small", "--config-dir", str(tmp_path))
    assert "batch 1 of 2, to step 64: candidates 2 of ippo" in shown
    assert shown.count("rule optimal acts in the first 32 steps") == 1


def test_values_that_do_not_go_together_are_told_before_training(
    opened: Opened, untrained: Untrained, tmp_path: Path
) -> None:
    """Here in the last batch."""
    text = SEARCH.replace("rollout.copies=2, rollout.block=2,", "").split("space:")[0]
    space = "space: {rollout.copies: [3, 4], rollout.block: [1, 2]}\nsampler: grid\nsampler_seed: 1\n"
    (tmp_path / "search" / "small.yaml").write_text(text.replace("batch: 2", "batch: 1") + space)
    with pytest.raises(HeadwayError, match=r"ippo: rollout\.block must divide copies \(3\), not 2"):
        opened("runs").run()
    assert not untrained.trained


def test_an_experiment_that_was_edited_is_noticed(opened: Opened, tmp_path: Path) -> None:
    (tmp_path / "experiment").mkdir()
    file = tmp_path / "experiment" / "ours.yaml"
    text = (tmp_path / "search" / "small.yaml").read_text()
    (tmp_path / "search" / "small.yaml").write_text(text.replace("env=trivial", "experiment=ours"))
    file.write_text("env: trivial\nalgo: {gamma: 0.9}\n")
    opened("runs")
    file.write_text("# the same\nenv: trivial\nalgo: {gamma: 0.9}\n")
    opened("runs", "store.checkpoint_every=7", "backend.parallel=1").require_settings()
    file.write_text("env: trivial\nalgo: {gamma: 0.8}\n")
    with pytest.raises(HeadwayError, match=r"ippo: this search has begun with algo\.gamma=0\.9, not 0\.8 "):
        opened("runs").require_settings()


@pytest.mark.usefixtures("untrained")
def test_one_session_at_a_time_runs_a_search(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search_session, "_LOCK_SECONDS", 0.0)
    session = opened("runs")
    line = r"search_small\.lock stayed locked .* while another session ran this search: end the session"
    with (
        locked(session.database.with_suffix(".lock"), 0.0, "tested"),
        pytest.raises(HeadwayError, match=line),
    ):
        session.run()


@pytest.mark.slow
def test_candidates_are_runs_of_the_store_and_no_step_is_trained_twice(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped after some sessions and continued, the search ends with the same scores and curves."""
    whole = opened("whole")
    assert whole.run() == EXIT_DONE
    run, sessions = Runner.run, 0

    def stopped(runner: Runner, report: bool = True) -> int:
        nonlocal sessions
        sessions += 1
        return EXIT_STOPPED if sessions == 4 else run(runner, report)

    with monkeypatch.context() as patch:
        patch.setattr(Runner, "run", stopped)
        assert opened("stopped").run() == EXIT_STOPPED
    again = opened("stopped")
    assert again.run() == EXIT_DONE
    assert states(again) == states(whole)
    curves = []
    for session in (whole, again):
        rows = RunIndex(session.root).rows("search_small")
        assert sorted((row.algorithm, row.env_steps) for row in rows) == sorted(
            (label, 128 if state == "COMPLETE" else 64)
            for label, candidates in states(session).items()
            for *_, state in candidates
        )
        assert {row.status for row in rows} == {"FINISHED", "KILLED"}
        assert all(row.cpu_seconds for row in rows)
        logged = {row.cell: read_rows(Path(row.directory), "curve") for row in rows}
        assert all([each["iteration"] for each in log] == [*range(len(log))] for log in logged.values())
        curves.append(
            {cell: [each["evaluation_greedy/return"] for each in log] for cell, log in sorted(logged.items())}
        )
    assert curves[0] == curves[1]
