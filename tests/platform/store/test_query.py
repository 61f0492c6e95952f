"""Selected runs of a store as frames."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pytest
from pyarrow.parquet import ParquetFile

from headway.contracts import HeadwayError
from headway.store.atomic_files import write_json, write_text
from headway.store.energy_log import EnergyLog
from headway.store.parquet_log import RunLog
from headway.store.query import select
from headway.store.run_folder import Process, RunRecord, Status, cell_name, create_run_folder, now, rules_file


def keep_run(
    root: Path,
    algorithm: str,
    seed: int,
    status: Status = "FINISHED",
    study: str = "bus",
    preset: str = "",
    **settings: str,
) -> str:
    parameters = {f"algo.{name}": value for name, value in settings.items()}
    cell = cell_name("bus", algorithm, parameters)
    run_id, directory = create_run_folder(root, study, cell, seed)
    elsewhere = replace(Process.current(), host="elsewhere")
    record = RunRecord(run_id, study, "bus", algorithm, seed, 3, now(), elsewhere, status, "shared")
    tags = {"version.headway": "1.2"}
    replace(record, parameters=parameters, tags=tags, preset=preset).write(directory)
    write_json(directory / "summary.json", {"final_reward": float(seed), "cpu_seconds": 2.0})
    write_text(directory / "config.yaml", f"seed: {seed}\n")
    log = RunLog(directory)
    for iteration in range(4):
        row: dict[str, float] = {"iteration": iteration, "env_steps": 10 * iteration, "wall_s": 0.5}
        measured = {"evaluation_greedy/return": float(iteration + seed)} if iteration % 2 == 0 else {}
        log.append("curve", [{**row, "training/return": 1.0, **measured}])
        for mode in ("greedy", "sampled"):
            label = {"mode": mode, "final": int(iteration == 3), "episode_seed": 5, "env_steps": iteration}
            log.append("evaluation", [{**label, "iteration": iteration, "return": 7.0}])
    log.commit(3)
    energy = EnergyLog(directory)
    energy.append({"time": 1.0, "kwh": 0.25})
    energy.write()
    episodes = [{"episode_seed": seed, "return": 10.0 * seed} for seed in range(2)]
    write_json(rules_file(root, study, cell), {"hold": episodes})
    return run_id


@pytest.fixture
def root(tmp_path: Path) -> Path:
    keep_run(tmp_path, "ippo", 0)
    keep_run(tmp_path, "ippo", 1, "KILLED")
    keep_run(tmp_path, "mappo", 0, lr="0.1")
    keep_run(tmp_path, "mappo", 0, lr="0.2")
    keep_run(tmp_path, "mappo", 1, study="other", lr="0.1")
    return tmp_path


def test_filters_take_one_value_or_several(root: Path) -> None:
    assert len(select(root).rows) == 5
    assert [row.algorithm for row in select(root, study="bus", seed=0).rows] == ["ippo", "mappo", "mappo"]
    of_a_frame = select(root, algorithm="ippo").runs()["seed"].iloc[0]  # a numpy integer
    assert {row.seed for row in select(root, seed=of_a_frame).rows} == {0}
    assert select(root, seed={0}).rows == select(root, seed=0).rows
    assert len(select(root, algorithm=("ippo", "mappo"), status="FINISHED").rows) == 4
    assert not select(root, status="RUNNING").rows
    last = select(root).rows[-1]
    assert select(root, run_id=last.run_id).rows == (last,)
    assert len(select(root, cell=last.cell).rows) == 2


def test_runs_can_be_selected_by_preset(root: Path) -> None:
    tuned = keep_run(root, "coma", 0, preset="bus_tuned")
    paper = keep_run(root, "coma", 0, preset="paper", lr="0.3")
    assert [row.run_id for row in select(root, preset="paper").rows] == [paper]
    assert {row.run_id for row in select(root, preset=("bus_tuned", "paper")).rows} == {tuned, paper}
    assert len(select(root, preset="").rows) == 5  # runs stored without a preset
    assert set(select(root, algorithm="coma").runs()["preset"]) == {"bus_tuned", "paper"}
    with pytest.raises(HeadwayError, match=r"has preset 'papre'; did you mean paper\?"):
        select(root, preset="papre")


def test_an_unknown_value_is_an_error_with_the_nearest_one(root: Path) -> None:
    with pytest.raises(HeadwayError, match=r"has algorithm 'mapo'; did you mean mappo\?"):
        select(root, algorithm="mapo")
    with pytest.raises(HeadwayError, match=r"no filter 'algoritm'; did you mean algorithm\?"):
        select(root, algoritm="mappo")  # type: ignore[arg-type]  # misspelt on purpose
    with pytest.raises(HeadwayError, match="there is no store"):
        select(root / "absent")
    with pytest.raises(HeadwayError, match="status"):
        select(root, status="finished")


def test_newest_keeps_the_last_run_of_a_seed(root: Path) -> None:
    again = keep_run(root, "ippo", 0)
    chosen = select(root, algorithm="ippo", seed=0, newest=True)
    assert [row.run_id for row in chosen.rows] == [again]


def test_every_frame_has_labels(root: Path) -> None:
    chosen = select(root, study="bus")
    frames = {
        "runs": (chosen.runs(), 4), "summaries": (chosen.summaries(), 4),
        "provenance": (chosen.provenance(), 4), "curves": (chosen.curves(), 16),
        "evaluations": (chosen.evaluations(), 32), "energy": (chosen.energy(), 4),
    }  # fmt: skip
    for name, (frame, rows) in frames.items():
        assert len(frame) == rows, name
        assert set(frame["controller"]) == {"ippo", "mappo, algo.lr=0.1", "mappo, algo.lr=0.2"}, name
        assert set(frame["task"]) == {"bus"}, name
    assert frames["summaries"][0]["cpu_seconds"].tolist() == [2.0] * 4
    assert set(frames["provenance"][0]["version.headway"]) == {"1.2"}
    assert frames["energy"][0]["kwh"].tolist() == [0.25] * 4
    assert set(chosen.configurations().values()) == {"seed: 0\n", "seed: 1\n"}


def test_only_requested_metrics_are_read(root: Path) -> None:
    found = select(root, algorithm="ippo", seed=0).curves(["evaluation_greedy/return", "absent"])
    assert found["env_steps"].tolist() == [0, 20]
    assert found["evaluation_greedy/return"].tolist() == [0, 2]
    assert "training/return" not in found
    with pytest.raises(
        HeadwayError, match="no curve has 'evaluation_gredy/return'; did you mean evaluation_g"
    ):
        select(root).curves(["evaluation_gredy/return"])


def test_evaluations_by_mode_and_final(root: Path) -> None:
    chosen = select(root, algorithm="ippo", seed=0)
    found = chosen.evaluations(["return"], mode="greedy", final=True)
    assert found[["iteration", "mode", "episode_seed", "return"]].to_numpy().tolist() == [[3, "greedy", 5, 7]]
    assert len(chosen.evaluations(final=False)) == 6


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"hold": 1}',
        '{"hold": [1]}',
        '{"hold": [{"return": 1.0}]}',
        '{"hold": [{"episode_seed": 0}]}',
    ],
)
def test_a_damaged_file_of_rules_is_named_or_left_out(root: Path, text: str) -> None:
    runs = select(root, study="bus")
    whole, first = runs.rules(), runs.rows[0]
    path = rules_file(root, first.study, first.cell)
    path.write_text(text)
    with pytest.raises(HeadwayError, match=rf"^{path} .*: remove or repair it$"):
        runs.rules()
    problems: list[str] = []
    # Other cells of the task have stored the same episodes.
    assert runs.rules(problems.append).equals(whole)
    assert [str(path) in problem for problem in problems] == [True]


def test_rules_shared_by_cells_appear_once(root: Path) -> None:
    found = select(root, study="bus").rules()
    assert found[["task", "rule", "episode_seed", "return"]].to_numpy().tolist() == [
        ["bus", "hold", 0, 0.0],
        ["bus", "hold", 1, 10.0],
    ]


def test_without_runs_frames_are_empty_and_have_labels(root: Path) -> None:
    nothing = select(root, status="RUNNING")
    frames = [nothing.runs(), nothing.curves(["x"]), nothing.episodes(), nothing.energy(), nothing.rules()]
    for frame in frames:
        assert frame.empty
        assert "task" in frame


def test_each_log_is_opened_once_and_one_record_per_cell(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(2, 12):
        keep_run(root, "ippo", seed)
    chosen = select(root, study="bus", algorithm="ippo")
    opened: list[tuple[Path, tuple[str, ...]]] = []
    recorded: list[Path] = []
    read_columns, read_record = ParquetFile.read, RunRecord.read

    class Counted(ParquetFile):
        def __init__(self, path: Path) -> None:
            super().__init__(path)
            self.path = path

        def read(self, columns: Sequence[str]) -> pa.Table:
            opened.append((self.path, tuple(columns)))
            return read_columns(self, columns)

    def counted(directory: Path) -> RunRecord:
        recorded.append(directory)
        return read_record(directory)

    monkeypatch.setattr("pyarrow.parquet.ParquetFile", Counted)
    monkeypatch.setattr(RunRecord, "read", counted)
    found = chosen.curves(["training/return"])
    assert len(found) == 12 * 4
    assert len(opened) == len({path for path, _ in opened}) == 12
    assert {columns for _, columns in opened} == {("iteration", "env_steps", "wall_s", "training/return")}
    assert len(recorded) == 1
