"""Environments that limit the copies per process get enough processes, or are refused in one line."""

import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from small_runs import SMALL, end_as

from headway.config.experiment import BackendConfig, ExperimentConfig, RolloutConfig
from headway.contracts import Discrete, EnvSpec, HeadwayError
from headway.store.parquet_log import read_rows
from headway.store.run_folder import Process
from headway_launch.commands.main import run
from headway_launch.experiments.compose import compose
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.parameters import cell_parameters, full_mapping, identity
from headway_launch.runner.cores import share_cores, uses_gpu, workers_of
from headway_launch.runner.jobs import new_jobs, plan_jobs, require_free_disk, within_processes
from headway_launch.runner.stored_run import StoredRun, jobs_to_resume

ONE = EnvSpec("bridge", ("north",), 1, Discrete(2), max_copies_per_process=1)
TWO = replace(ONE, max_copies_per_process=2)
SIX = replace(ONE, max_copies_per_process=6)


def _config(copies: int, block: int, **backend: object) -> ExperimentConfig:
    return ExperimentConfig(
        seed=(1, 2, 3), rollout=RolloutConfig(copies, 10, block), backend=BackendConfig(**backend)
    )


@pytest.mark.parametrize(
    ("spec", "copies", "block", "stack", "expected"),
    [
        (ONE, 8, 4, 1, (1, 8)),
        (SIX, 8, 4, 1, (4, 2)),
        (SIX, 9, 9, 1, (3, 2)),
        (SIX, 8, 8, 2, (4, 4)),
        (SIX, 8, 2, 3, (2, 4)),
        (ONE, 1, 1, 5, (1, 3)),
        (TWO, 4, 2, 3, (2, 6)),
    ],
)
def test_blocks_shrink_alike_for_any_stack_and_workers_grow(
    spec: EnvSpec, copies: int, block: int, stack: int, expected: tuple[int, int]
) -> None:
    fitted = within_processes(_config(copies, block, stack=stack), spec)
    assert (fitted.rollout.block, fitted.backend.workers) == expected


def test_a_configuration_within_the_limit_is_unchanged() -> None:
    free = replace(ONE, max_copies_per_process=None)
    for spec, config in (
        (free, _config(8, 4)),
        (ONE, _config(1, 1, name="serial")),
        (ONE, _config(4, 1, workers=4)),
        (SIX, _config(8, 4, workers=2)),
    ):
        assert within_processes(config, spec) == config


@pytest.mark.parametrize(
    ("spec", "config", "line"),
    [
        (ONE, _config(2, 1, name="serial"), "1 copy of bridge; set rollout.copies=1, or backend=process"),
        (ONE, _config(8, 1, workers=2), "1 copy of bridge; set backend.workers=8, or leave it out"),
        (ONE, _config(8, 1, stack=2, workers=8), "1 copy of bridge; set backend.workers=16, or leave it out"),
        (
            SIX,
            _config(8, 8, stack=3, name="serial"),
            "6 copies of bridge; set rollout.copies=2 and rollout.block=2, or backend=process",
        ),
        (TWO, _config(2, 1, stack=3, name="serial"), "2 copies of bridge; set backend.stack=1, or backend="),
        (
            TWO,
            _config(9, 3, stack=3, name="serial", workers=1),
            "2 copies of bridge; set backend.stack=1 and rollout.copies=2 and rollout.block=1, "
            "or backend=process and backend.workers=18",
        ),
    ],
)
def test_refusals_name_settings_that_work(spec: EnvSpec, config: ExperimentConfig, line: str) -> None:
    with pytest.raises(HeadwayError, match=f"a process can hold {line}") as refusal:
        within_processes(config, spec)
    ways = str(refusal.value).split("; set ")[1].split(", or ")
    for way in ways:
        within_processes(_with_settings(way, config), spec)


def _with_settings(way: str, config: ExperimentConfig) -> ExperimentConfig:
    """Return the configuration with the settings that an error line proposes."""
    changed: dict[str, dict[str, Any]] = {"rollout": {}, "backend": {}}
    for setting in way.replace("leave it out", "backend.workers=").split(" and "):
        key, value = setting.split("=")
        group, _, name = key.partition(".")
        changed[group][name or "name"] = (int(value) if value else None) if name else value
    return replace(
        config,
        rollout=replace(config.rollout, **changed["rollout"]),
        backend=replace(config.backend, **changed["backend"]),
    )


def _limited(*overrides: str) -> Experiment:
    """Return an experiment whose environment is limited to four copies per process."""
    bare = ("env=mpe2.simple_spread_v3", "env.max_copies_per_process=4")
    return compose([*bare, "algo=ippo", "seed=0,1", "rollout.copies=8", *overrides])


def test_jobs_have_the_workers_that_their_own_configuration_needs() -> None:
    """Independent of the session's first cell and of the share of cores."""
    plain = compose(["env=trivial", "algo=ippo", "seed=0,1", "backend.workers=1"])
    requested = compose(["env=trivial", "algo=ippo", "seed=0", "backend.workers=2"])
    serial = compose(["env=trivial", "algo=ippo", "seed=0", "backend=serial"])
    limited = _limited("rollout.block=8")
    cells = [new_jobs(each, each.config.seed) for each in (plain, requested, serial, limited)]
    jobs = [job for cell in cells for job in cell]
    for cores, parallel in ((1, 1), (2, 1), (8, 4)):
        shares = share_cores(plain.config.backend, jobs, cores)
        assert shares.parallel == parallel
        assert [workers_of(job, shares) for job in jobs] == [1, 1, 2, 1, 2, 2]
    assert {job.config.rollout.block for job in cells[-1]} == {4}
    assert all(job.experiment is limited for job in cells[-1])  # stored as it was requested


def test_a_stack_has_one_worker_per_part_that_a_process_can_hold() -> None:
    words = ["env=mpe2.simple_spread_v3", "env.max_copies_per_process=1", "algo=ippo"]
    stacked = compose([*words, "seed=0..6", "backend.stack=5", "rollout.copies=2", "rollout.block=2"])
    jobs = plan_jobs(stacked)
    for cores, cluster_cpus, parallel in ((2, None, 1), (3, None, 1), (4, None, 2), (9, 19, 1), (9, 20, 2)):
        shares = share_cores(stacked.config.backend, jobs, cores, cluster_cpus)
        assert shares.parallel == parallel  # on a cluster every worker counts
        assert [workers_of(job, shares) for job in jobs] == [10, 4]  # stacks of five and two seeds


def test_jobs_use_a_gpu_by_their_own_device() -> None:
    [job] = new_jobs(compose(["env=trivial", "device=cpu"]), (0,))
    assert not uses_gpu(job)
    on_gpu = replace(job.training, config=replace(job.config, device="cuda:1"))
    assert uses_gpu(replace(job, training=on_gpu))


def test_a_budget_in_which_policies_would_never_split_is_refused() -> None:
    """The last of n iterations begins at (n - 1) / n of training."""
    copies = ("rollout.copies=2", "rollout.steps=10", "rollout.block=2")
    words = ["env=visitors", "algo=ippo", "algo.policies=independent", *copies]
    for share, enough in ((0.5, 2), (0.7, 4), (0.9, 10)):
        words_of_share = [*words, f"algo.shared_until={share}"]
        line = (
            rf"with {enough - 1} iterations? of 20 steps .* the last iteration .* algo.shared_until={share}"
        )
        with pytest.raises(HeadwayError, match=line):
            plan_jobs(compose([*words_of_share, f"env_steps={20 * (enough - 1)}"]))
        assert len(plan_jobs(compose([*words_of_share, f"env_steps={20 * enough}"]))) == 1


def test_the_disk_must_have_room_for_replay_buffers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three checkpoints per seed (two kept, one being written) of the jobs that run in parallel."""
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=2**30))
    words = ["env=trivial", "env_steps=1000000", "seed=0..2", "algo=madqn", "algo.policies=independent"]
    small, large = (plan_jobs(compose([*words, f"algo.capacity={size}"])) for size in (1000, 1_000_000))
    require_free_disk(tmp_path, small, 2)
    with pytest.raises(HeadwayError, match=r"only 1,024 MiB are free .* 3 seeds need about 3,\d{3} MiB"):
        require_free_disk(tmp_path, large, 2)
    without_replay = plan_jobs(compose(["env=trivial", "algo=ippo", "seed=0..2"]))
    require_free_disk(tmp_path, without_replay, 2)
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=50 * 2**20))
    require_free_disk(tmp_path, without_replay, 2)
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=49 * 2**20))
    with pytest.raises(HeadwayError, match=r"only 49 MiB are free .* 3 seeds need about 50 MiB"):
        require_free_disk(tmp_path, without_replay, 2)


def test_a_store_that_cannot_be_created_is_reported_before_its_free_space(tmp_path: Path) -> None:
    jobs = plan_jobs(compose(["env=trivial", "algo=ippo"]))
    (tmp_path / "file").touch()
    for place in (tmp_path / "file" / "store", Path("/proc/nowhere")):
        with pytest.raises(HeadwayError, match=f"cannot write {place} .*: choose another folder"):
            require_free_disk(place, jobs, 1)


def _asynchronous(*overrides: str) -> Experiment:
    bare = ("env=tracking", "algo=a3c", "seed=0,1", "rollout.copies=8", "rollout.block=2")
    return compose([*bare, *overrides])


def _limited_a3c(*overrides: str) -> Experiment:
    return _limited("algo=a3c", "rollout.block=8", "seed=0..8", *overrides)


def test_the_number_of_asynchronous_workers_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    four = "a3c has 4 workers (rollout.copies / rollout.block) and computes one gradient per rollout of 2 x"
    for overrides, line in (((), four), (("rollout.block=8",), "a3c has 1 worker (")):
        plan_jobs(_asynchronous(*overrides))
        shown = "".join(capsys.readouterr())
        assert shown.count("worker") == 1
        assert f"headway: {line}" in shown


def test_an_asynchronous_algorithm_has_one_worker_per_block_on_any_number_of_cores() -> None:
    jobs = plan_jobs(_asynchronous())
    assert [job.seeds for job in jobs] == [(0,), (1,)]
    shares = share_cores(jobs[0].config.backend, jobs, cores=2)
    assert (shares.parallel, workers_of(jobs[0], shares)) == (1, 4)
    assert share_cores(jobs[0].config.backend, jobs, cores=8).parallel == 2
    (alone, _) = plan_jobs(_asynchronous("backend=serial"))
    assert workers_of(alone, shares) == 1
    assert plan_jobs(_asynchronous("backend.workers=4"))[0].config.backend.workers == 4
    assert plan_jobs(_asynchronous("backend.stack=2", "seed=7"))[0].seeds == (7,)


@pytest.mark.parametrize(
    ("experiment", "override", "line"),
    [
        (
            _asynchronous,
            "backend.workers=3",
            "one worker per block of copies, 4 here.*leave out backend.workers",
        ),
        (_asynchronous, "backend.stack=2", "a3c trains one seed per process, .*set backend.stack=1"),
        (
            _limited_a3c,
            "backend.workers=1",
            "one worker per block of copies, 2 here.*leave out backend.workers",
        ),
        (_limited_a3c, "backend.stack=9", "a3c trains one seed per process, .*set backend.stack=1"),
    ],
)
def test_invalid_settings_of_an_asynchronous_algorithm_print_one_line(
    experiment: Callable[[str], Experiment], override: str, line: str
) -> None:
    """Limited copies lead to the same advice."""
    with pytest.raises(HeadwayError, match=line) as refusal:
        plan_jobs(experiment(override))
    assert "\n" not in str(refusal.value)


def test_blocks_of_an_asynchronous_algorithm_shrink_to_the_limit_of_copies() -> None:
    job = plan_jobs(_limited_a3c())[0]
    assert (job.config.rollout.block, job.config.backend.workers) == (4, 2)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["env=trivial", "algo=ippo", "start.rule=optmal"], "'optmal' is not a rule of trivial .*optimal"),
        (
            ["env=trivial", "algo=ippo", "start.rule=optmal", "env_steps=9", "start.env_steps=9"],
            "'optmal' is not a rule of trivial to start from; did you mean optimal",
        ),
        (["env=trivial", "algo=ippo", "start.rule=random"], "'random' is not a rule of trivial"),
        (
            ["env=trivial", "algo=ippo", "start.rule=random", "env.wrappers=[clip_reward_v0]"],
            "'random' is not a rule of trivial",
        ),
        (
            ["env=tracking", "algo=a3c", "start.rule=optimal"],
            "a3c starts from random parameters only; .*=ippo",
        ),
        (
            [
                "env=trivial",
                "algo=custom",
                "algo.critic=none",
                "start.rule=optimal",
                "start.critic_iterations=2",
            ],
            "algo.critic=none has no critic to train first; add start.critic_iterations=0",
        ),
        (["env=mpe2.simple_spread_v3", "algo=ippo", "start.rule=x"], "has no rule to start from; leave it"),
        (
            ["env=visitors", "algo=ippo", "start.rule=optimal", "env.wrappers=[pad_action_space_v0]"],
            "start.rule: ",
        ),
    ],
)
def test_rules_that_training_cannot_start_from_are_refused(words: list[str], line: str) -> None:
    with pytest.raises(HeadwayError, match=line):
        plan_jobs(compose([*words, "evaluation.rules=[]"]))


THOUSANDS = ["rollout.copies=8", "rollout.steps=125"]
"""Iterations of 1,000 steps."""


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["start.rule=optimal", "start.env_steps=0"], "start.env_steps must be at least 1, not 0"),
        (["start.rule=optimal", "start.env_steps=9000"], "of 9000 leaves nothing of env_steps=9000"),
        (
            ["start.rule=optimal", "start.env_steps=9", "start.critic_iterations=8", *THOUSANDS],
            "critic_iterations of 8 leaves no iteration .* there are 8, of 1000 .* set at most 7, or raise",
        ),
        (["start.env_steps=10"], "start.env_steps applies to a rule: set start.rule too, or leave this out"),
        (["start.kl_coeff=1"], "start.kl_coeff applies after a start: set start.rule or start.run too"),
        (["start.critic_iterations=2"], "start.critic_iterations applies after a start: set start.rule"),
        (["start.rule=optimal", "start.kl_coeff=-1"], "start.kl_coeff must be at least 0, not -1"),
    ],
)
def test_budgets_of_a_start_that_leave_nothing_to_learn_are_refused(words: list[str], line: str) -> None:
    with pytest.raises(HeadwayError, match=line):
        compose(["env=trivial", "algo=ippo", "env_steps=9000", *words])


def test_the_entropy_of_imitation_is_refused_without_a_rule() -> None:
    words = ["env=trivial", "algo=ippo", "algo.imitation_entropy_coeff=0.2"]
    with pytest.raises(
        HeadwayError, match=r"^algo\.imitation_entropy_coeff applies to a rule: set start.rule"
    ):
        plan_jobs(compose(words))
    plan_jobs(compose([*words, "start.rule=optimal", "start.env_steps=9"]))


def test_a_critic_may_learn_first_in_all_iterations_but_one() -> None:
    words = ["start.rule=optimal", "start.env_steps=9", "start.critic_iterations=7", *THOUSANDS]
    assert compose(["env=trivial", "algo=ippo", "env_steps=9000", *words]).config.rule_iterations == 1


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["algo=madqn", "start.critic_iterations=2"],
            "madqn: this algorithm supports neither .* add start.kl_coeff=0 start.critic_iterations=0",
        ),
        (
            ["algo=madqn", "start.kl_coeff=0.1"],
            "madqn: .* supports neither start.kl_coeff nor .* such as algo=ippo",
        ),
        (
            ["algo=itrpo", "start.kl_coeff=0.1"],
            "itrpo: .* algo.update=trpo bounds its steps by itself; lower",
        ),
        (["algo=maacktr", "start.kl_coeff=0.1"], "maacktr: .* algo.update=kfac bounds its steps by itself"),
        (["algo=ippo", "algo.model.core=gru", "start.kl_coeff=0.1"], "ippo: .* is for feedforward policies"),
    ],
)
def test_algorithms_that_cannot_stay_near_a_start_are_refused(words: list[str], line: str) -> None:
    with pytest.raises(HeadwayError, match=line):
        plan_jobs(compose(["env=trivial", "start.rule=optimal", *words]))


@pytest.mark.parametrize(
    "words", [["algo=itrpo"], ["algo=ippo", "algo.model.core=gru"], ["algo=ippo", "start.kl_coeff=0.1"]]
)
def test_a_critic_can_learn_first_with_every_on_policy_algorithm(words: list[str]) -> None:
    plan_jobs(compose(["env=trivial", "start.rule=optimal", "start.critic_iterations=2", *words]))


def test_a_start_from_a_rule_is_a_cell_of_its_own() -> None:
    bare = compose(["env=trivial", "algo=ippo"])
    started = compose(["env=trivial", "algo=ippo", "start.rule=optimal"])
    assert identity(full_mapping(bare, (0,))) != identity(full_mapping(started, (0,)))
    keys = {"start.rule": "optimal", "start.env_steps": 50_000}
    assert cell_parameters(started) == {**cell_parameters(bare), **keys}
    held = compose(["env=trivial", "algo=ippo", "start.rule=optimal", "start.kl_coeff=0.1"])
    assert identity(full_mapping(held, (0,))) != identity(full_mapping(started, (0,)))
    assert cell_parameters(held) == {**cell_parameters(started), "start.kl_coeff": 0.1}
    # Runs stored before the key existed are the same runs.
    before = {key: value for key, value in full_mapping(bare, (0,)).items() if key != "start"}
    assert identity(before) == identity(full_mapping(bare, (0,)))


@pytest.fixture(scope="module")
def parents(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Store with a stack of two runs, of seeds 0 and 1."""
    root = tmp_path_factory.mktemp("parents")
    words = ["run", "env=trivial", "algo=mappo", "seed=0,1", "backend.stack=2", "backend=serial", *SMALL]
    assert run([*words, f"store.root={root}"]) == 0
    return root


def test_training_starts_from_the_policies_of_one_run_of_a_stack(parents: Path, tmp_path: Path) -> None:
    """The first point of the curve is the last of the parent's, on the same episodes."""
    [folder] = (parents / "default").glob("*-s1-*")
    words = ["run", "env=trivial", "algo=mappo", "seed=7", f"start.run={folder.name[-12:]}", *SMALL]
    assert run([*words, f"store.root={parents}", "study=children", "backend=serial"]) == 0
    [child] = (parents / "children").glob("*-s7-*")
    first, last = read_rows(child, "curve")[0], read_rows(folder, "curve")[-1]
    assert first["evaluation_greedy/return"] == last["evaluation_greedy/return"]
    stored = yaml.safe_load((child / "config.yaml").read_text())
    assert stored["start"]["run"] == folder.name


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["algo.model.hidden=[8,8]"], r"\(bias_0 is \(1, 64, 1\) there and \(1, 8, 1\) here\); start from"),
        (["algo.model.hidden=[8]"], "only theirs have bias_2.; start from a run .* algo.model"),
        (["env=visitors"], "have another shape .*same observations, actions"),
        (["algo.policies=independent", "algo.shared_until=0.5"], "start.run takes over separate policies"),
        (["start.rule=optimal"], "start.run excludes start.rule"),
        (["start.run=s9"], "start.run: no run 's9' in .*: `headway runs` lists "),
        (["algo=a3c"], "a3c starts from random parameters only; add start.r.*=null, or use another"),
        (
            ["algo=madqn"],
            "a run of mappo, are of another kind .only those here have exploration.; start from a",
        ),
        (["algo.model.activation=relu"], r"activation=tanh, .* has relu; set algo\.model\.activation=tanh"),
        (["algo.normalise_observations=false"], "trained with algo.normalise_observations=True, and this"),
    ],
)
def test_runs_that_training_cannot_start_from_are_refused(words: list[str], line: str, parents: Path) -> None:
    words = ["env=trivial", "algo=mappo", f"store.root={parents}", "start.run=-s1-", *words]
    with pytest.raises(HeadwayError, match=line):
        plan_jobs(compose(words))


def test_networks_with_outputs_in_other_units_are_not_taken_over(parents: Path, tmp_path: Path) -> None:
    """A critic of standardised returns would be read as one of returns; Q-networks likewise."""
    of_parent = ["env=trivial", "algo=mappo", f"store.root={parents}", "start.run=-s1-"]
    for words, taken in ([], True), (["algo.normalise_values=false"], False):
        [job] = plan_jobs(compose([*of_parent, *words]))
        assert job.training.parent is not None
        assert job.training.parent.with_critic == taken
    words = ["env=trivial", "algo=madqn", f"store.root={tmp_path}"]
    assert run(["run", *words, "backend=serial", *SMALL]) == 0
    plan_jobs(compose([*words, "start.run=-s0-"]))
    with pytest.raises(
        HeadwayError, match=r"normalise_rewards=True, .* False; set algo\.normalise_rewards=T"
    ):
        plan_jobs(compose([*words, "start.run=-s0-", "algo.normalise_rewards=false"]))


def test_a_child_that_lost_its_checkpoints_starts_from_its_parent_again(parents: Path) -> None:
    """A child with a checkpoint does not need its parent, which may be deleted."""
    words = ["env=trivial", "algo=mappo", "seed=8", "start.run=-s1-", *SMALL, "study=lost", "backend=serial"]
    assert run(["run", *words, f"store.root={parents}"]) == 0
    [child] = (parents / "lost").glob("*-s8-*")
    end_as(child)
    [[job]] = jobs_to_resume([StoredRun.read(parents, child)])
    assert job.training.parent is None
    shutil.rmtree(child / "checkpoints")
    [[job]] = jobs_to_resume([StoredRun.read(parents, child)])
    assert job.training.parent is not None
    assert "-s1-" in job.training.parent.directory


def test_a_run_that_still_trains_is_no_start(parents: Path) -> None:
    [parent] = (parents / "default").glob("*-s0-*")
    end_as(parent, "RUNNING", session=asdict(Process.current()))
    words = ["env=trivial", "algo=mappo", f"store.root={parents}", "start.run=-s0-"]
    with pytest.raises(HeadwayError, match="is still training; start from it when it has ended"):
        plan_jobs(compose(words))
    end_as(parent, "FINISHED")


CURRICULUM = ["env=merge", "algo=ippo", "preset=none", "env.args={density: 3, max_density: 3}"]
STAGES = "stages=[{env_steps: 4000, training_args: {density: 1}}, {env_steps: 5000}]"


def test_each_stage_has_its_environment_and_their_sum_is_the_budget() -> None:
    experiment = compose([*CURRICULUM, STAGES, "env.training_args.reward.scope=own"])
    assert (experiment.config.env_steps, experiment.env_config.density) == (9000, 3)
    [job] = plan_jobs(experiment)
    plans = [job.training.plan, *job.training.later_plans]
    configs = [plan.training_prepared.config for plan in plans]
    assert [(config.density, config.reward.scope) for config in configs] == [(1, "own"), (3, "own")]
    assert [plan.prepared.config.reward.scope for plan in plans] == ["global", "global"]
    assert [plan.stage for plan in plans] == [0, 1]
    assert all(plan.spec == job.training.spec for plan in plans)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["env.args={density: 3}", STAGES],
            r"stages\[0\]\.training_args may change .* \(3 agents here and 6, state_size 43 here and 78 in "
            r"evaluation\); set such arguments in env\.args, .* such as max_density of merge",
        ),
        (
            [
                "env.args={density: 3, max_density: 3}",
                "stages=[{env_steps: 4000, training_args: {reward: {scope: own}}}, {env_steps: 5000}]",
            ],
            r"stages\[1\]\.training_args .*\(shared_reward True here and False in stages\[0\]\)",
        ),
        (
            ["env.args={density: 3, max_density: 2}"],
            "env.args.max_density must be null, or 1, 2 or 3 and at least density, not 2",
        ),
        (
            [
                "env.args={density: 2, max_density: 2}",
                "stages=[{env_steps: 9000, training_args: {density: 3}}]",
            ],
            r"^stages\[0\]\.training_args: env\.args\.max_density must be null, or 1, 2 or 3 and at least",
        ),
        (
            ["env.args={density: 3}", "stages=[{env_steps: 9000, training_args: {max_density: 2}}]"],
            r"^stages\[0\]\.training_args\.max_density must be null, or 1, 2 or 3 and at least",
        ),
        (["stages=[{env_steps: 9000, training_args: {densty: 1}}]"], r"stages\[0\].*did you mean .*density"),
        (["stages=[{env_steps: 9000, args: {density: 1}}]"], r"stages\[0\]\.args"),
        (["stages=[{training_args: {density: 1}}]"], r"stages\[0\]\.env_steps is missing and has no default"),
        (["stages=9"], "stages=9 is a whole number, where a list of mappings is expected"),
        (
            ["env.args={density: 3, max_density: 3}", "algo=a3c", STAGES],
            "stages: the workers of a3c do not wait for each other, .* another algorithm, such as algo=ia2c",
        ),
        (
            [STAGES, "env_steps=10000"],
            "env_steps of 10000 is not the sum of the stages', 9000; set env_steps=9_000, or change",
        ),
    ],
)
def test_stages_that_do_not_fit_are_refused(words: list[str], line: str) -> None:
    with pytest.raises(HeadwayError, match=line) as refusal:
        plan_jobs(compose(["env=merge", "algo=ippo", "preset=none", *words]))
    assert "\n" not in str(refusal.value)


def test_stages_make_another_cell_and_none_are_as_before() -> None:
    bare, staged = (compose([*CURRICULUM, *more]) for more in (["env_steps=9000"], [STAGES]))
    assert identity(full_mapping(bare, (0,))) != identity(full_mapping(staged, (0,)))
    assert "stages" in cell_parameters(staged)
    assert "stages" not in cell_parameters(bare)
    before = {key: value for key, value in full_mapping(bare, (0,)).items() if key != "stages"}
    assert identity(before) == identity(full_mapping(bare, (0,)))


def test_a_stored_run_is_resumed_in_its_stages(tmp_path: Path) -> None:
    words = [*CURRICULUM, "seed=7", *SMALL, "backend=serial", f"store.root={tmp_path}"]
    short = "stages=[{env_steps: 64, training_args: {density: 1}}, {env_steps: 128}]"
    assert run(["run", *[word for word in words if not word.startswith("env_steps")], short]) == 0
    [folder] = (tmp_path / "default").glob("*-s7-*")
    stored = yaml.safe_load((folder / "config.yaml").read_text())
    assert stored["env_steps"] == 192
    [[job]] = jobs_to_resume([StoredRun.read(tmp_path, folder)])
    later = [plan.training_prepared.config.density for plan in job.training.later_plans]
    assert (job.training.plan.training_prepared.config.density, later) == (1, [3])
