"""Which runs of a study count, the line about the others, and the names of its cells."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path

import pytest
import yaml

from headway.contracts.errors import HeadwayError
from headway.store import RunIndex, RunRecord, Status
from headway.store.cell_names import cell_names, labelled_cells
from headway.store.run_folder import Process, create_run_folder
from headway_launch.studies.runs import configuration, finished_runs

_SECONDS = count()
"""Runs begin one after another: those of one millisecond would be ordered by their random names."""


def keep_run(
    root: Path,
    seed: int,
    status: Status,
    started: str = "",
    policies: str = "",
    preset: str = "",
    candidate: str = "",
    **parameters: str,
) -> str:
    run_id, directory = create_run_folder(root, "bus", "cell", seed)
    elsewhere = replace(Process.current(), host="elsewhere")  # counts as running
    moment = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=next(_SECONDS))
    started = started or moment.isoformat(timespec="milliseconds")
    record = RunRecord(run_id, "bus", "bus", "ippo", seed, 10, started, elsewhere, status, policies)
    replace(record, parameters=parameters, preset=preset, candidate=candidate).write(directory)
    return run_id


def test_runs_left_out_are_counted_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    statuses: tuple[Status, ...] = ("FINISHED", "KILLED", "FINISHED", "RUNNING", "KILLED")
    for seed, status in enumerate(statuses):
        keep_run(tmp_path, seed, status)
    assert [run.seed for run in finished_runs(tmp_path, "bus")] == [0, 2]
    assert capsys.readouterr().err == (
        "headway: runs of bus left out: 3 not finished (2 KILLED, 1 RUNNING)\n"
    )


def test_a_seed_that_was_trained_twice_is_one_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keep_run(tmp_path, 3, "FINISHED", "2026-01-01T00:00:00.000+00:00")
    newest = keep_run(tmp_path, 3, "FINISHED", "2026-01-03T00:00:00.000+00:00")
    keep_run(tmp_path, 3, "FINISHED", "2026-01-02T00:00:00.000+00:00")
    other = keep_run(tmp_path, 3, "FINISHED", "2026-01-04T00:00:00.000+00:00", lr="0.1")
    assert [run.run_id for run in finished_runs(tmp_path, "bus")] == [newest, other]
    assert "2 superseded by a newer run of the same seed" in capsys.readouterr().err


def test_nothing_is_printed_if_no_run_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep_run(tmp_path, 0, "FINISHED")
    finished_runs(tmp_path, "bus")
    assert capsys.readouterr().err == ""


def test_a_study_without_finished_runs_says_what_it_has(tmp_path: Path) -> None:
    keep_run(tmp_path, 0, "FAILED")
    with pytest.raises(HeadwayError, match=r"no finished run \(1 FAILED\)"):
        finished_runs(tmp_path, "bus")
    with pytest.raises(HeadwayError, match=r"no study 'bsu' .*did you mean bus\?"):
        finished_runs(tmp_path, "bsu")


def test_cells_of_a_study_are_named_by_their_differences(tmp_path: Path) -> None:
    for seed, policies, rate in (
        (0, "shared", "0.001"),
        (1, "shared", "0.001"),
        (0, "shared", "0.01"),
        (0, "independent", "0.001"),
    ):
        parameters = {"algo.policies": policies, "algo.lr": rate}
        keep_run(tmp_path, seed, "FINISHED", policies=policies, **parameters)
    keep_run(tmp_path, 0, "FINISHED", policies="shared", **{"algo.policies": "shared"})
    cells = labelled_cells(RunIndex(tmp_path).rows())
    assert {label: sorted(run.seed for run in members) for label, members in cells.items()} == {
        "ippo, independent": [0],
        "ippo, shared, algo.lr=0.001": [0, 1],
        "ippo, shared, algo.lr=0.01": [0],
        "ippo, shared, without algo.lr": [0],
    }


def test_a_configuration_is_read_without_the_c_loader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not every build of PyYAML has the C loader."""
    monkeypatch.delattr(yaml, "CSafeLoader", raising=False)
    (tmp_path / "config.yaml").write_text("study: bus")
    assert configuration(str(tmp_path)) == {"study": "bus"}
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.yaml").write_text("algo: [")
    with pytest.raises(HeadwayError, match=r"config\.yaml cannot be read"):
        configuration(str(tmp_path / "broken"))


def test_wrappers_with_infinite_arguments_have_names(tmp_path: Path) -> None:
    """Wrappers are stored as the text of a list; those that only change rewards belong to the controller."""
    clipped = "{'name': 'clip_reward_v0', 'lower_bound': -inf, 'upper_bound': 10.0}"
    stacked = "{'name': 'frame_stack_v1', 'stack_size': 2, 'stack_dim': -1}"
    keep_run(tmp_path, 0, "FINISHED", **{"env.wrappers": f"[{clipped}, {stacked}]"})
    keep_run(tmp_path, 0, "FINISHED", **{"env.wrappers": f"[{stacked}]"})
    keep_run(tmp_path, 0, "FINISHED")
    names = cell_names(RunIndex(tmp_path).rows()).values()
    assert {name.task for name in names} == {f"bus, env.wrappers=[{stacked}]", "bus, without env.wrappers"}
    assert {name.controller for name in names} == {
        f"ippo, env.wrappers=[{clipped}]",
        "ippo, without env.wrappers",
        "ippo",
    }


def test_wrappers_that_only_change_rewards_make_no_separate_task(tmp_path: Path) -> None:
    keep_run(tmp_path, 0, "FINISHED", **{"env.wrappers": "[{'name': 'scale_reward_v0', 'scale': 0.05}]"})
    keep_run(tmp_path, 0, "FINISHED")
    names = cell_names(RunIndex(tmp_path).rows()).values()
    assert {name.task for name in names} == {"bus"}
    assert len({name.controller for name in names}) == 2


def test_a_name_lists_the_first_of_many_differing_settings(tmp_path: Path) -> None:
    many = {f"algo.key_{place}": "1" for place in range(9)}
    for parameters in (many, dict.fromkeys(many, "2")):
        keep_run(tmp_path, 0, "FINISHED", policies="shared", **parameters)
    assert list(labelled_cells(RunIndex(tmp_path).rows())) == [
        f"ippo, algo.key_0={value}, algo.key_1={value}, algo.key_2={value}, 6 settings more"
        for value in (1, 2)
    ]
    # One that differs from the first in the last setting only: now all must be named.
    keep_run(tmp_path, 0, "FINISHED", policies="shared", **{**many, "algo.key_8": "2"})
    labels = list(labelled_cells(RunIndex(tmp_path).rows()))
    assert len(set(labels)) == 3
    assert all("algo.key_8" in label for label in labels)


TUNED = {"algo.lr": "0.002", "algo.gamma": "0.98", "env.training_args.reward.scope": "regional"}
PAPER = {"algo.lr": "0.0005", "algo.gamma": "0.99", "algo.clip": "0.2"}


def test_cells_of_several_presets_are_named_by_these(tmp_path: Path) -> None:
    """Settings of the presets stay out of the names; others appear if they distinguish cells."""
    keep_run(tmp_path, 0, "FINISHED", preset="merge_tuned", policies="shared", **TUNED)
    keep_run(tmp_path, 0, "FINISHED", preset="merge_paper", policies="independent", **PAPER)
    keep_run(
        tmp_path, 0, "FINISHED", preset="merge_paper", policies="independent", **PAPER | {"algo.lr": "1"}
    )
    keep_run(tmp_path, 0, "FINISHED", preset="none", policies="independent", **{"algo.lr": "0.1"})
    names = cell_names(RunIndex(tmp_path).rows()).values()
    assert [name.controller for name in names] == [
        "ippo merge_tuned",
        "ippo merge_paper, algo.lr=0.0005",
        "ippo merge_paper, algo.lr=1",
        "ippo without preset",
    ]
    assert {name.task for name in names} == {"bus"}


def test_one_preset_needs_no_name(tmp_path: Path) -> None:
    for rate in ("1", "2"):
        keep_run(tmp_path, 0, "FINISHED", preset="merge_paper", **PAPER | {"algo.lr": rate})
    names = cell_names(RunIndex(tmp_path).rows()).values()
    assert sorted(name.label for name in names) == ["ippo, algo.lr=1", "ippo, algo.lr=2"]


def test_a_cell_is_named_by_the_preset_that_one_of_its_runs_records(tmp_path: Path) -> None:
    keep_run(tmp_path, 0, "FINISHED", **PAPER)
    keep_run(tmp_path, 1, "FINISHED", preset="merge_paper", **PAPER)
    keep_run(tmp_path, 0, "FINISHED", preset="merge_tuned", **TUNED)
    assert list(labelled_cells(RunIndex(tmp_path).rows())) == ["ippo merge_paper", "ippo merge_tuned"]


def test_the_cells_of_a_search_are_named_by_its_candidates(tmp_path: Path) -> None:
    """Settings of a candidate stay out of the names unless its cells differ."""
    for rate in ("1", "2"):
        keep_run(tmp_path, 0, "FINISHED", candidate="short", **{"algo.lr": rate, "algo.clip": "0.1"})
    keep_run(tmp_path, 0, "FINISHED", candidate="long, own reward", **{"algo.lr": "1", "algo.clip": "0.3"})
    assert set(labelled_cells(RunIndex(tmp_path).rows())) == {
        "ippo: short, algo.lr=1",
        "ippo: short, algo.lr=2",
        "ippo: long, own reward",
    }
    keep_run(tmp_path, 0, "FINISHED", **{"algo.lr": "4", "algo.clip": "0.3"})  # outside the search
    assert "ippo, algo.clip=0.1, algo.lr=1" in labelled_cells(RunIndex(tmp_path).rows())


def test_a_cell_is_named_by_the_candidate_that_its_newest_run_records(tmp_path: Path) -> None:
    keep_run(tmp_path, 0, "FINISHED", "2020-01-01T00:00:00+00:00", **{"algo.lr": "1"})
    keep_run(tmp_path, 1, "FINISHED", candidate="short", **{"algo.lr": "1"})
    keep_run(tmp_path, 0, "FINISHED", candidate="long", **{"algo.lr": "2"})
    assert list(labelled_cells(RunIndex(tmp_path).rows())) == ["ippo: long", "ippo: short"]


def test_arguments_of_a_task_have_the_names_of_its_environment(tmp_path: Path) -> None:
    for supervisor in ("True", "False"):
        keep_run(tmp_path, 0, "FINISHED", **{"env.args.supervisor": supervisor, "env.args.steps": "9"})
    keep_run(tmp_path, 0, "FINISHED", **{"env.args.supervisor": "False"})
    names = cell_names(RunIndex(tmp_path).rows()).values()
    assert {name.task for name in names} == {
        "bus, supervisor=True, steps=9",
        "bus, supervisor=False, steps=9",
        "bus, supervisor=False, without steps",
    }


def test_cells_are_named_by_settings_if_a_preset_is_unknown(tmp_path: Path) -> None:
    keep_run(tmp_path, 0, "FINISHED", **{"algo.lr": "1"})
    keep_run(tmp_path, 0, "FINISHED", preset="merge_paper", **{"algo.lr": "2"})
    assert list(labelled_cells(RunIndex(tmp_path).rows())) == ["ippo, algo.lr=1", "ippo, algo.lr=2"]


def test_presets_distinguish_environments_with_different_arguments(tmp_path: Path) -> None:
    """Two presets of the same environment are on one task."""
    aggregate, whole = {"env.args.state": "aggregate"}, {"env.args.state": "whole"}
    keep_run(tmp_path, 0, "FINISHED", preset="bus_tuned", **aggregate)
    keep_run(tmp_path, 0, "FINISHED", preset="paper", **whole)
    assert {name.label for name in cell_names(RunIndex(tmp_path).rows()).values()} == {
        "ippo on bus bus_tuned",
        "ippo on bus paper",
    }
    keep_run(tmp_path, 0, "FINISHED", preset="bus_tuned_independent", **aggregate, **PAPER)
    names = cell_names(RunIndex(tmp_path).rows()).values()
    assert {(name.controller, name.task) for name in names} == {
        ("ippo bus_tuned", "bus, state=aggregate"),
        ("ippo paper", "bus, state=whole"),  # named as elsewhere
        ("ippo bus_tuned_independent", "bus, state=aggregate"),
    }
