"""Progress of a sweep in the store, and the jobs that remain."""

from pathlib import Path

import pytest
from command_lines import failed, output, refused
from stored_runs import keep, keep_run

from headway.contracts.errors import HeadwayError
from headway.store.atomic_files import read_json
from headway.store.index import RunIndex
from headway.store.run_folder import plans_folder
from headway.store.session import SessionStore
from headway_launch.commands.main import run
from headway_launch.experiments.sweep import compose_sweep
from headway_launch.runner.cell import SessionCell
from headway_launch.runner.cores import CoreShares, workers_of
from headway_launch.studies.plan import StudyProgress, keep_plan, kept_plans, plan_cells
from headway_launch.studies.session import StudySession, require_all_ended

BASE = ("env=trivial", "study=toys", "energy=off", "backend=serial", "env_steps=4096")


def progress(root: Path, *overrides: str) -> StudyProgress:
    [experiment] = compose_sweep([*BASE, f"store.root={root}", *overrides])
    return StudyProgress.of(root, experiment, RunIndex(root).rows("toys"))


def test_the_progress_of_a_seed_is_that_of_its_best_run(tmp_path: Path) -> None:
    [experiment] = compose_sweep([*BASE, "algo=ippo"])
    finished = keep_run(tmp_path, experiment, 0, "FINISHED")
    keep_run(tmp_path, experiment, 0, "KILLED", 9)
    keep_run(tmp_path, experiment, 1, "KILLED", 3)
    farthest = keep_run(tmp_path, experiment, 1, "FAILED", 5)
    held = keep_run(tmp_path, experiment, 2, "RUNNING")
    state = progress(tmp_path, "algo=ippo", "seed=0..4")
    assert [each.record.run_id for each in state.finished] == [finished]
    assert [each.record.run_id for each in state.unfinished] == [farthest]
    assert [each.record.run_id for each in state.elsewhere] == [held]
    assert state.new == (3, 4)
    assert len(state.run_ids) == 5


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ("backend=process", True), ("energy.country=FRA", True), ("store.checkpoint_every=3", True),
        ("evaluation.rules=[random]", True), ("algo.lr=1e-3", False), ("env.args.agents=3", False),
        ("evaluation.episodes=3", False), ("env_steps=8192", False),
    ],
)  # fmt: skip
def test_only_settings_that_change_the_curves_make_a_new_run(tmp_path: Path, change: str, same: bool) -> None:
    keep_run(tmp_path, compose_sweep([*BASE, "algo=ippo"])[0], 0, "FINISHED")
    state = progress(tmp_path, "algo=ippo", change)
    assert (len(state.finished), len(state.new)) == ((1, 0) if same else (0, 1))


@pytest.mark.parametrize(("before", "after"), [("process", "ray"), ("ray", "process"), ("ray", "ray")])
def test_processes_and_ray_workers_resume_each_others_runs(tmp_path: Path, before: str, after: str) -> None:
    words = ["algo=ippo", "backend.workers=2", "backend.learners=here"]
    [experiment] = compose_sweep([*BASE, *words, f"backend={before}", "backend.address=old:1"])
    keep_run(tmp_path, experiment, 0, "KILLED", 7)
    [cell] = plan_cells([progress(tmp_path, *words, f"backend={after}", "backend.address=new:2")])
    (job,) = cell.jobs
    assert (len(job.resumed), job.iteration, job.workers) == (1, 7, 1)
    assert (job.config.backend.name, job.config.backend.address) == (after, "new:2")


def test_resumed_runs_take_the_session_settings_but_keep_their_backend(tmp_path: Path) -> None:
    [experiment] = compose_sweep([*BASE, "algo=ippo"])
    run_id = keep_run(tmp_path, experiment, 0, "KILLED", 7)
    words = ("algo=ippo", "backend=process", "backend.parallel=5", "seed=0,1")
    [cell] = plan_cells([progress(tmp_path, *words)])
    resumed, new = cell.jobs
    assert (resumed.resumed, resumed.iteration, resumed.workers) == ((run_id,), 7, 1)
    assert resumed.experiment.config.backend.name == "serial"
    assert resumed.experiment.config.backend.parallel == 5
    assert resumed.experiment.config.store.root == str(tmp_path)
    assert (new.resumed, new.seeds, new.experiment.config.backend.name) == ((), (1,), "process")


def test_smaller_blocks_than_requested_are_the_same_configuration(tmp_path: Path) -> None:
    """A run is identified by its requested blocks, and resumes with those that it was trained with."""
    limited = ("algo=ippo", "env=mpe2.simple_spread_v3",
               "env.max_copies_per_process=2", "backend=process", "evaluation.rules=[]")  # fmt: skip
    [cell] = plan_cells([progress(tmp_path, *limited, "seed=0")])
    store = SessionStore(cell.experiment.config.store)
    work = SessionCell(store, cell)
    [run] = work.runs(cell.jobs[0], CoreShares(1, 1))
    run.finish("KILLED", {})
    store.close()
    assert read_json(run.directory / "plan.json")["rollout"]["block"] == 2
    state = progress(tmp_path, *limited, "seed=0")
    assert [each.record.run_id for each in state.unfinished] == [run.run_id]
    [cell] = plan_cells([state])
    assert cell.jobs[0].config.rollout.block == 2
    assert workers_of(cell.jobs[0], CoreShares(1, 1)) == 4
    assert cell.experiment.config.rollout.block == 4


def test_seeds_of_a_stack_resume_or_start_together(tmp_path: Path) -> None:
    [experiment] = compose_sweep([*BASE, "algo=ippo", "backend.stack=2"])
    for seed, status in ((0, "FINISHED"), (1, "KILLED")):  # killed while ending the stack
        keep_run(tmp_path, experiment, seed, status, 9, (0, 1))  # type: ignore[arg-type]
    keep_run(tmp_path, experiment, 2, "KILLED", 0, (2, 3))  # killed while starting the stack
    for seed in (4, 5):
        keep_run(tmp_path, experiment, seed, "FINISHED", 9, (4, 5))
    state = progress(tmp_path, "algo=ippo", "backend.stack=2", "seed=0..5")
    assert sorted(run.record.seed for run in state.unfinished) == [0, 1]
    assert [run.record.seed for run in state.finished] == [4, 5]
    assert state.new == (2, 3)
    [cell] = plan_cells([state])
    assert [(job.seeds, bool(job.resumed)) for job in cell.jobs] == [((0, 1), True), ((2, 3), False)]


def test_a_part_of_a_stack_is_refused_with_a_way_to_resume(tmp_path: Path) -> None:
    [experiment] = compose_sweep([*BASE, "algo=ippo", "backend.stack=4"])
    for seed in range(4):
        keep_run(tmp_path, experiment, seed, "KILLED", 5, (0, 1, 2, 3))
    state = progress(tmp_path, "algo=ippo", "backend.stack=4", "seed=0,1")
    with pytest.raises(HeadwayError) as caught:
        plan_cells([state])
    assert "sweep seed=0,1,2,3, or headway resume --study toys" in str(caught.value)


def test_a_plan_is_kept_once_and_read_back(tmp_path: Path) -> None:
    experiments = compose_sweep([*BASE, "algo=ippo,ia2c", "seed=0..2"])
    keep_plan(tmp_path, "toys", experiments)
    keep_plan(tmp_path, "toys", experiments)
    keep_plan(tmp_path, "toys", compose_sweep([*BASE, "algo=ippo", "seed=2..4", "backend.parallel=7"]))
    assert len(list(plans_folder(tmp_path, "toys").iterdir())) == 2
    kept = {experiment.algo_name: experiment for experiment in kept_plans(tmp_path, "toys")}
    assert set(kept) == {"ippo", "ia2c"}
    assert sorted(kept["ippo"].config.seed) == [0, 1, 2, 3, 4]
    assert kept["ippo"].config.store.root == str(tmp_path)
    assert kept["ippo"].config.backend.parallel == 7  # of the newest plan
    assert kept["ia2c"].algo_config == experiments[1].algo_config


def test_the_plan_of_a_study_with_a_similar_name_is_not_its_own(tmp_path: Path) -> None:
    overrides = ["env=trivial", "algo=ippo", "study='my toys'", "seed=0..2"]
    keep_plan(tmp_path, "my toys", compose_sweep(overrides))
    assert plans_folder(tmp_path, "my toys") == plans_folder(tmp_path, "my-toys")
    assert len(kept_plans(tmp_path, "my toys")) == 1
    assert kept_plans(tmp_path, "my-toys") == []


def test_a_broken_plan_prints_one_line(tmp_path: Path) -> None:
    plans_folder(tmp_path, "toys").mkdir(parents=True)
    (plans_folder(tmp_path, "toys") / "x.json").write_text('{"cells": [1]}')
    with pytest.raises(HeadwayError, match=r"x\.json is not the plan of a sweep"):
        kept_plans(tmp_path, "toys")


def test_a_finished_sweep_is_skipped_and_its_table_printed(tmp_path: Path) -> None:
    sweep = [*BASE, "algo=ippo,ia2c", "seed=0,1", "evaluation.rules=[]", f"store.root={tmp_path}"]
    for experiment in compose_sweep(sweep):
        for seed in (0, 1):
            summary = {"final_reward": 2.0 + seed, "auc": 0.5, "cpu_seconds": 10.0, "kwh": None}
            keep_run(tmp_path, experiment, seed, "FINISHED", **summary)
    shown = output("sweep", *sweep)
    assert "4 runs of study toys: 4 finished and skipped\n" in shown.err
    rows = [line.split("\t") for line in shown.out.splitlines()]
    assert rows[1][:6] == ["ippo", "2 of 2", "2.5", "0.7071", "0.5", "20"]
    assert rows[2][0] == "ia2c"
    assert len(RunIndex(tmp_path).rows()) == 4
    assert run(["resume", "--study", "toys", "--store", str(tmp_path)]) == 0
    assert "did you mean toys?" in refused("resume", "--study", "tyos", "--store", str(tmp_path))


HELD = (
    "headway: 1 run of study toys not finished, in other sessions (process 1 on elsewhere); "
    "repeat this command when these have ended; if one was killed, repeat it on that host or set "
    '"status": "KILLED" in its runs\' run.json'
)


def test_runs_of_another_session_are_left_to_it_with_a_way_to_continue(tmp_path: Path) -> None:
    small = ("env_steps=64", "rollout.copies=4", "rollout.block=2", "rollout.steps=16")
    sweep = [*BASE, "algo=ippo", *small, "seed=0,1", "evaluation.rules=[]", f"store.root={tmp_path}"]
    [experiment] = compose_sweep(sweep)
    keep_run(tmp_path, experiment, 0, "FINISHED")
    held = keep_run(tmp_path, experiment, 1, "RUNNING")
    store = ("--store", str(tmp_path))
    shown = output("sweep", *sweep).err.splitlines()
    assert "headway: 2 runs of study toys: 1 finished and skipped, 1 in other sessions" in shown
    assert shown[-1] == output("resume", "--study", "toys", *store).err.splitlines()[-1] == HELD
    with pytest.raises(HeadwayError, match="1 run of study toys not finished, in other sessions"):
        StudySession.plan([experiment]).train()  # as scripts do, which need all runs
    assert failed("resume", held, *store) == (
        f"headway: run {held} is being run by process 1 on elsewhere: stop that process first, or, if it was "
        'killed, set "status": "KILLED" in the run\'s run.json\n'
    )
    [record] = tmp_path.rglob(f"{held}/run.json")
    record.write_text(record.read_text().replace('"RUNNING"', '"KILLED"'))
    [killed] = progress(tmp_path, "algo=ippo", *small, "seed=1").unfinished
    assert killed.record.run_id == held
    assert run(["sweep", *sweep]) == 0
    assert [row.status for row in RunIndex(tmp_path).rows()] == ["FINISHED", "FINISHED"]


def test_runs_that_another_session_has_finished_are_no_error(tmp_path: Path) -> None:
    [experiment] = compose_sweep([*BASE, "algo=ippo"])
    held = keep_run(tmp_path, experiment, 0, "RUNNING")
    [record] = tmp_path.rglob(f"{held}/run.json")
    with pytest.raises(HeadwayError, match=r"^1 run of study toys not finished, in other sessions"):
        require_all_ended("toys", [record.parent])
    assert run(["resume", "--study", "toys", "--store", str(tmp_path)]) == 0  # of no sweep
    record.write_text(record.read_text().replace('"RUNNING"', '"FINISHED"'))
    require_all_ended("toys", [record.parent])
    assert run(["resume", "--study", "toys", "--store", str(tmp_path)]) == 0


SMALL = ("algo=ippo", "env_steps=64", "rollout.copies=4", "rollout.block=2", "rollout.steps=16",
         "evaluation.rules=[]")  # fmt: skip


def _trained(session: StudySession) -> tuple[list[Path], list[tuple[int, str]]]:
    """Return the runs that the session leaves to others, and (seed, status) of all stored runs."""
    runner = session.open_runner(debug=False)
    assert runner.run() == 0
    rows = RunIndex(Path(session.experiments[0].config.store.root)).rows()
    return runner.left_to_others(), [(row.seed, row.status) for row in rows]


def test_simultaneous_sessions_train_seeds_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The second is planned before the first has begun any run."""
    keep_run(tmp_path, compose_sweep([*BASE, *SMALL, f"store.root={tmp_path}"])[0], 3, "KILLED")
    first, second, fresh = (
        StudySession.plan(
            compose_sweep([*BASE, *SMALL, f"store.root={tmp_path}", f"seed={seeds}"]), fresh=new
        )
        for seeds, new in (("0,1,3", False), ("1,2,3", False), ("1", True))
    )
    finished = [(seed, "FINISHED") for seed in (3, 0, 1)]
    assert _trained(first) == ([], finished)
    capsys.readouterr()
    left, stored = _trained(second)
    assert stored == [*finished, (2, "FINISHED")]
    assert left == []
    table = [line.split("\t")[:2] for line in capsys.readouterr().out.splitlines()]
    assert table[1:4] == [[seed, "FINISHED"] for seed in "123"]  # those of the other session too
    assert _trained(fresh) == ([], [*stored, (1, "FINISHED")])


def test_damaged_records_of_the_study_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is left out: their seeds are trained."""
    experiments = compose_sweep([*BASE, *SMALL, f"store.root={tmp_path}", "seed=0"])
    broken = tmp_path / "toys" / keep_run(tmp_path, experiments[0], 0, "FINISHED") / "run.json"
    elsewhere = keep(tmp_path, "other", 0) / "run.json"
    for record in (broken, elsewhere):
        record.write_text("{")
    assert [each.new for each in StudySession.plan(experiments).progress] == [(0,)]
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"headway: {broken} cannot be read (")
    assert "left out" not in line


def test_a_seed_whose_run_in_another_session_has_failed_is_trained(tmp_path: Path) -> None:
    experiments = compose_sweep([*BASE, *SMALL, f"store.root={tmp_path}", "seed=0"])
    session = StudySession.plan(experiments)
    keep_run(tmp_path, experiments[0], 0, "FAILED")
    assert _trained(session) == ([], [(0, "FAILED"), (0, "FINISHED")])


def test_a_stack_waits_for_another_sessions_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The seeds of a stack are trained in one process, so the others are left too, with exit code 2."""
    first, second = (
        StudySession.plan(
            compose_sweep([*BASE, *SMALL, f"store.root={tmp_path}", f"seed={seeds}", "backend.stack=2"])
        )
        for seeds in ("0,1", "1,2")
    )
    _trained(first)
    runner = second.open_runner(debug=False)
    assert runner.run() == 2
    assert runner.left_to_others() == []
    assert "headway: 1 run not started; to continue: " in capsys.readouterr().err
    assert sorted(row.seed for row in RunIndex(tmp_path).rows()) == [0, 1]
    again = compose_sweep([*BASE, *SMALL, f"store.root={tmp_path}", "seed=1,2", "backend.stack=2"])
    assert [list(each.new) for each in StudySession.plan(again).progress] == [[2]]
