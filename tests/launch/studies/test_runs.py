"""Which runs of a study count, the line about the others, and the names of its cells."""

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path

import pytest
import yaml
from stored_runs import ELSEWHERE, RESULTS, keep

from headway.contracts.errors import HeadwayError
from headway.store.cell_names import CellChoice, labelled_cells, names_among
from headway.store.index import RunIndex
from headway.store.run_folder import Status
from headway_launch.studies.runs import configuration, finished_runs

_SECONDS = count()
"""Runs begin one after another: those of one millisecond would be ordered by their random names."""


def keep_run(
    root: Path, seed: int, status: Status, started: str = "", policies: str = "", preset: str = "",
    candidate: str = "", **parameters: str,
) -> str:  # fmt: skip
    moment = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=next(_SECONDS))
    started = started or moment.isoformat(timespec="milliseconds")
    names = {"policies": policies, "preset": preset, "candidate": candidate, "parameters": parameters}
    return keep(root, "bus", seed, started=started, session=ELSEWHERE, status=status, **RESULTS, **names).name


def test_runs_left_out_are_counted_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    statuses: tuple[Status, ...] = ("FINISHED", "KILLED", "FINISHED", "RUNNING", "KILLED")
    for seed, status in enumerate(statuses):
        keep_run(tmp_path, seed, status)
    assert [run.seed for run in finished_runs(tmp_path, "bus").rows] == [0, 2]
    assert capsys.readouterr().err == (
        "headway: runs of bus left out: 3 not finished (2 KILLED, 1 RUNNING)\n"
    )


def test_a_seed_trained_twice_is_one_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep_run(tmp_path, 3, "FINISHED", "2026-01-01T00:00:00.000+00:00")
    newest = keep_run(tmp_path, 3, "FINISHED", "2026-01-03T00:00:00.000+00:00")
    keep_run(tmp_path, 3, "FINISHED", "2026-01-02T00:00:00.000+00:00")
    other = keep_run(tmp_path, 3, "FINISHED", "2026-01-04T00:00:00.000+00:00", lr="0.1")
    assert [run.run_id for run in finished_runs(tmp_path, "bus").rows] == [newest, other]
    assert "2 superseded by a newer run of the same seed" in capsys.readouterr().err


def test_a_damaged_repeat_leaves_an_older_run_of_its_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three runs have seed 3, of which the newest is damaged; two have seed 4, of which the older is damaged
    and superseded anyway."""
    first, older, newest, other, last = [keep_run(tmp_path, seed, "FINISHED") for seed in (3, 3, 3, 4, 4)]
    for damaged in (newest, other):
        (tmp_path / "bus" / damaged / "config.yaml").unlink()
    assert [run.run_id for run in finished_runs(tmp_path, "bus").rows] == [older, last]
    shown = capsys.readouterr().err
    assert [name in shown for name in (first, older, newest, other, last)] == [
        False,
        False,
        True,
        False,
        False,
    ]
    assert "headway: runs of bus left out: 2 superseded by a newer run of the same seed, 1 damaged\n" in shown


@pytest.mark.parametrize(
    ("name", "text", "remedy"),
    [
        ("run.json", '{"run_id": "', "remove or repair it"),
        ("summary.json", "[1]", "remove or repair it"),
        ("config.yaml", "{[", "restore it, or remove this run's folder"),
        ("config.yaml", "", "restore it, or remove this run's folder"),
        ("config.yaml", "env: {}\nevalua", "restore it, or remove this run's folder"),
        ("config.yaml", "env: {}\nevaluation: {}\n", "restore it, or remove this run's folder"),
        ("config.yaml", None, "restore it, or remove this run's folder"),
        ("curve-000001.parquet", "PAR1", "restore it, or remove this run's folder"),
        ("curve-000002.parquet", "PAR1", "remove it to use the rest"),
        ("curve-000001.parquet", None, "restore it, or remove this run's folder"),
        ("evaluation-000001.parquet", "", "remove it to use the rest"),
    ],
)
def test_a_damaged_run_is_left_out_and_named(
    name: str, text: str | None, remedy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(3):
        keep_run(tmp_path, seed, "FINISHED")
    damaged = Path(RunIndex(tmp_path).rows("bus")[1].directory, name)
    if text is None:
        damaged.unlink()
    else:
        damaged.write_text(text)
    assert [run.seed for run in finished_runs(tmp_path, "bus").rows] == [0, 2]
    line, count = capsys.readouterr().err.splitlines()
    file = name if text is not None or name == "config.yaml" else ""
    assert line.startswith(f"headway: run {damaged.parent.name} is left out: {damaged.parent / file}")
    assert line.endswith(f": {remedy}")
    assert count == "headway: runs of bus left out: 1 damaged"


@pytest.mark.parametrize("name", ["config.yaml", "run.json"])
def test_a_study_whose_runs_are_all_damaged_says_so(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(2):
        (tmp_path / "bus" / keep_run(tmp_path, seed, "FINISHED") / name).write_text("{[")
    with pytest.raises(HeadwayError, match="every finished run of study 'bus' is damaged"):
        finished_runs(tmp_path, "bus")
    assert capsys.readouterr().err.count(f"{name} cannot be read") == 2


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


def test_the_runs_of_a_cell_have_its_name(tmp_path: Path) -> None:
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


def test_a_cell_is_named_beside_those_that_have_not_finished(tmp_path: Path) -> None:
    """Otherwise the first curve of a sweep over algo.lr would not say which value it has; a run whose record
    is broken takes part in no name."""
    keep_run(tmp_path, 0, "FINISHED", **{"algo.lr": "0.001", "algo.gamma": "0.9"})
    keep_run(tmp_path, 0, "KILLED", **{"algo.lr": "0.01", "algo.gamma": "0.9"})
    broken = keep_run(tmp_path, 0, "RUNNING", **{"algo.lr": "0.01", "algo.gamma": "0.8"})
    RunIndex(tmp_path).rows()
    (tmp_path / "bus" / broken / "run.json").write_text("{")
    runs = finished_runs(tmp_path, "bus")
    assert [name.label for name in runs.names.values() if "0.001" in name.label] == ["ippo, algo.lr=0.001"]
    assert list(labelled_cells(runs.rows, runs.beside)) == ["ippo, algo.lr=0.001"]
    assert set(runs.runs()["label"]) == {"ippo, algo.lr=0.001"}


def test_configuration_is_read_without_the_c_loader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not every build of PyYAML has the C loader."""
    monkeypatch.delattr(yaml, "CSafeLoader", raising=False)
    (tmp_path / "config.yaml").write_text("study: bus")
    assert configuration(str(tmp_path)) == {"study": "bus"}
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.yaml").write_text("algo: [")
    with pytest.raises(
        HeadwayError, match=r"config\.yaml cannot be read .*: restore it, or remove this run's"
    ):
        configuration(str(tmp_path / "broken"))


def cell(parameters: Mapping[str, str], preset: str = "", candidate: str = "", study: str = "") -> CellChoice:
    return CellChoice("bus", "ippo", preset, parameters, candidate, study)


def labels_of(cells: Iterable[CellChoice]) -> list[str]:
    return [
        name.label for name in names_among({str(place): each for place, each in enumerate(cells)}).values()
    ]


CLIPPED = "{'name': 'clip_reward_v0', 'lower_bound': -inf, 'upper_bound': 10.0}"
STACKED = "{'name': 'frame_stack_v1', 'stack_size': 2, 'stack_dim': -1}"
SHARED, OWN = {"algo.policies": "shared"}, {"algo.policies": "independent"}
TUNED = {"algo.lr": "0.002", "algo.gamma": "0.98", "env.training_args.reward.scope": "regional"}
PAPER = {"algo.lr": "0.0005", "algo.gamma": "0.99", "algo.clip": "0.2"}
STACKS = f"bus, env.wrappers=[{STACKED}]"
STAGES = str([{"env_steps": 250_000, "training_args": {"density": density}} for density in (1, 2, 3)])
AGGREGATE, WHOLE = {"env.args.state": "aggregate"}, {"env.args.state": "whole"}


NAMED = {
    "wrappers; those that only change rewards make no separate task": [
        (cell({"env.wrappers": f"[{CLIPPED}, {STACKED}]"}), f"ippo, env.wrappers=[{CLIPPED}] on {STACKS}"),
        (cell({"env.wrappers": f"[{STACKED}]"}), f"ippo, without env.wrappers on {STACKS}"),
        (cell({}), "ippo on bus, without env.wrappers"),
    ],
    "presets, whose settings stay out of the names": [
        (cell(SHARED | TUNED, "merge_tuned"), "ippo merge_tuned"),
        (cell(OWN | PAPER, "merge_paper"), "ippo merge_paper, algo.lr=0.0005"),
        (cell(OWN | PAPER | {"algo.lr": "1"}, "merge_paper"), "ippo merge_paper, algo.lr=1"),
        (cell(OWN | {"algo.lr": "0.1"}, "none"), "ippo without preset"),
    ],
    "one preset needs no name": [
        (cell(PAPER | {"algo.lr": "1"}, "merge_paper"), "ippo, algo.lr=1"),
        (cell(PAPER | {"algo.lr": "2"}, "merge_paper"), "ippo, algo.lr=2"),
    ],
    "an unknown preset": [
        (cell({"algo.lr": "1"}), "ippo, algo.lr=1"),
        (cell({"algo.lr": "2"}, "merge_paper"), "ippo, algo.lr=2"),
    ],
    "presets distinguish tasks with different arguments": [
        (cell(AGGREGATE, "bus_tuned"), "ippo on bus bus_tuned"),
        (cell(WHOLE, "paper"), "ippo on bus paper"),
    ],
    "two presets of the same environment are on one task": [
        (cell(AGGREGATE, "bus_tuned"), "ippo bus_tuned on bus, state=aggregate"),
        (cell(WHOLE, "paper"), "ippo paper on bus, state=whole"),  # named as elsewhere
        (cell(AGGREGATE | PAPER, "bus_own"), "ippo bus_own on bus, state=aggregate"),
    ],
    "candidates, whose settings stay out unless their cells differ": [
        (cell({"algo.lr": "1", "algo.clip": "0.1"}, candidate="short"), "ippo: short, algo.lr=1"),
        (cell({"algo.lr": "2", "algo.clip": "0.1"}, candidate="short"), "ippo: short, algo.lr=2"),
        (cell({"algo.lr": "1", "algo.clip": "0.3"}, candidate="long, own"), "ippo: long, own"),
    ],
    "studies, whose settings stay out unless cells of one differ": [
        (cell({"algo.lr": "1"}, "paper", study="further"), "further: ippo"),
        (cell({"algo.lr": "2", "start.run": "bus-0"}, study="started"), "started: ippo, algo.lr=2"),
        (cell({"algo.lr": "3", "start.run": "bus-0"}, study="started"), "started: ippo, algo.lr=3"),
    ],
    "studies on different tasks": [
        (cell(AGGREGATE, study="first"), "ippo on bus, state=aggregate"),
        (cell(WHOLE, study="second"), "ippo on bus, state=whole"),
    ],
    "a study's name is shown on all tasks": [
        (cell(AGGREGATE, study="first"), "first: ippo on bus, state=aggregate"),
        (cell(WHOLE, study="first"), "first: ippo on bus, state=whole"),
        (cell(WHOLE | TUNED, study="second"), "second: ippo on bus, state=whole"),
    ],
    "a cell outside the search": [
        (cell({"algo.lr": "1"}, candidate="short"), "ippo, algo.lr=1"),
        (cell({"algo.lr": "2"}, candidate="long"), "ippo, algo.lr=2"),
        (cell({"algo.lr": "4"}), "ippo, algo.lr=4"),
    ],
    "arguments of a task, without their prefix": [
        (cell({"env.args.kept": "True", "env.args.steps": "9"}), "ippo on bus, kept=True, steps=9"),
        (cell({"env.args.kept": "False", "env.args.steps": "9"}), "ippo on bus, kept=False, steps=9"),
        (cell({"env.args.kept": "False"}), "ippo on bus, kept=False, without steps"),
    ],
    "a long value that others lack": [
        (cell({"stages": STAGES}), "ippo, with stages"),
        (cell({}), "ippo, without stages"),
    ],
    "two long values": [
        (cell({"stages": STAGES}), f"ippo, stages={STAGES}"),
        (
            cell({"stages": f"{STAGES[:-1]}, {{'env_steps': 1}}]"}),
            f"ippo, stages={STAGES[:-1]}, {{'env_steps': 1}}]",
        ),
        (cell({}), "ippo, without stages"),
    ],
}


@pytest.mark.parametrize("named", NAMED.values(), ids=NAMED)
def test_cells_are_named_by_their_differences(named: list[tuple[CellChoice, str]]) -> None:
    assert labels_of(each for each, _ in named) == [label for _, label in named]


def test_a_name_lists_the_first_of_many_differing_settings() -> None:
    many = {f"algo.key_{place}": "1" for place in range(9)}
    two = [cell(many), cell(dict.fromkeys(many, "2"))]
    assert labels_of(two) == [
        f"ippo, algo.key_0={value}, algo.key_1={value}, algo.key_2={value}, 6 settings more"
        for value in (1, 2)
    ]
    # One that differs from the first in the last setting only: now all must be named.
    labels = labels_of([*two, cell({**many, "algo.key_8": "2"})])
    assert len(set(labels)) == 3
    assert all("algo.key_8" in label for label in labels)


def test_a_cell_is_named_by_the_preset_that_one_of_its_runs_records(tmp_path: Path) -> None:
    keep_run(tmp_path, 0, "FINISHED", **PAPER)
    keep_run(tmp_path, 1, "FINISHED", preset="merge_paper", **PAPER)
    keep_run(tmp_path, 0, "FINISHED", preset="merge_tuned", **TUNED)
    assert list(labelled_cells(RunIndex(tmp_path).rows())) == ["ippo merge_paper", "ippo merge_tuned"]


def test_a_cell_is_named_by_the_candidate_that_its_newest_run_records(tmp_path: Path) -> None:
    keep_run(tmp_path, 0, "FINISHED", "2020-01-01T00:00:00+00:00", **{"algo.lr": "1"})
    keep_run(tmp_path, 1, "FINISHED", candidate="short", **{"algo.lr": "1"})
    keep_run(tmp_path, 0, "FINISHED", candidate="long", **{"algo.lr": "2"})
    assert list(labelled_cells(RunIndex(tmp_path).rows())) == ["ippo: long", "ippo: short"]
