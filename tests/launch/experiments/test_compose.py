import json
from dataclasses import replace
from functools import cache

import pytest
import yaml
from covering import pairwise, quick_or_slow

from headway.config.experiment import ExperimentConfig, RolloutConfig
from headway.config.schema import build, describe
from headway.contracts import HeadwayError
from headway.registry import algo_entries, env_entries, rule_entry
from headway.rollout.episodes import evaluate_rule
from headway.store.run_configuration import upgraded
from headway_launch.experiments.compose import compose, require_rule, resolve
from headway_launch.experiments.options import configs_folder, options, summary_of
from headway_launch.experiments.parameters import cell_parameters, full_mapping
from headway_launch.experiments.search import read_search
from headway_launch.experiments.search_space import corners
from headway_launch.experiments.sweep import compose_sweep
from headway_launch.runner.cores import CoreShares, share_cores
from headway_launch.runner.jobs import new_jobs, plan_jobs
from headway_launch.studies.plan import distinct


def test_overrides_reach_keys_that_no_file_has() -> None:
    experiment = compose(
        ["env=trivial", "algo=ippo", "algo.lr=3e-4", "env.args.agents=3", "rollout.steps=1e2", "seed=0..2"]
    )
    assert experiment.algo_config.lr == 3e-4
    assert experiment.env_config.agents == 3
    assert experiment.config.rollout.steps == 100
    assert experiment.config.seed == (0, 1, 2)


def test_algo_custom_composes_unnamed_algorithms() -> None:
    composed = compose(["env=trivial", "algo=custom", "algo.critic=central"])
    assert composed.algo_config.critic == "central"
    with pytest.raises(
        HeadwayError, match=r"ippo has critic=local\. .*For central: algo=mappo; any with algo=custom"
    ):
        compose(["env=trivial", "algo=ippo", "algo.critic=central"])


def test_a_preset_of_another_environment_is_named() -> None:
    with pytest.raises(
        HeadwayError,
        match=r"preset=bus_tuned does not fit this experiment: env\.training_args\.reward\.follower_share is",
    ):
        compose(["experiment=merge_study", "preset=bus_tuned"])
    with pytest.raises(HeadwayError, match=r"^env\.args\.state is not a key of merge"):
        compose(["experiment=merge_study", "env.args.state=whole"])


def test_a_preset_overrides_defaults_and_is_overridden_by_options() -> None:
    experiment = compose(["env=trivial", "preset=paper", "algo.clip=0.1", "rollout.steps=128"])
    assert experiment.config.preset == "paper"
    assert compose(["env=trivial"]).config.preset == "none"
    assert experiment.algo_config.gae_lambda == 1.0
    assert experiment.algo_config.clip == 0.1
    assert experiment.config.rollout.steps == 128


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("env=tracking", "algo=ippo"), (8, 128, 4)),
        (("env=tracking", "algo=a3c"), (8, 32, 2)),
        (("env=tracking", "algo=a3c", "rollout={copies:6,block:3}"), (6, 32, 3)),
        (("experiment=toy_trivial", "algo=ia2c"), (8, 128, 4)),
        (("env=trivial", "algo=ia2c", "preset=paper"), (10, 100, 5)),
    ],
)
def test_an_algorithm_brings_the_rollout_that_files_and_options_override(
    words: tuple[str, ...], expected: tuple[int, int, int]
) -> None:
    assert compose(words).config.rollout == RolloutConfig(*expected)


@pytest.mark.parametrize(
    ("override", "meant"),
    [
        ("reward.scope=own", "env.args.reward.scope=own"),
        ("gae_lambda=0.9", "algo.gae_lambda=0.9"),
        ("steps=50", "env_steps or rollout.steps or env.args.steps=50"),
        ("total_timesteps=50", "env_steps=50"),
        ("rollout.total_timesteps=50", "env_steps"),
        ("learning_rate=1e-3", "algo.lr=1e-3"),
    ],
)
def test_a_key_without_its_first_parts_is_completed(override: str, meant: str) -> None:
    key = override.partition("=")[0]
    with pytest.raises(HeadwayError) as caught:
        compose(["env=merge", "algo=mappo", override, "seed=1"])
    assert str(caught.value) == f"{key} is not a key of the experiment; did you mean {meant}?"


def test_the_bus_environment_has_a_default_preset() -> None:
    """An algorithm without values in it keeps its defaults; the evaluation environment is the same."""
    default, tuned = compose(["env=bus"]), compose(["env=bus", "preset=bus_tuned"])
    assert default.config.preset == "default_bus"
    assert default.algo_config == tuned.algo_config
    assert default.training_env_configs[0] == tuned.training_env_configs[0]
    assert default.config.rollout == tuned.config.rollout
    assert compose(["env=bus", "algo.clip=0.07"]).algo_config.clip == 0.07
    untuned = compose(["env=bus", "algo=madqn"])
    assert untuned.config.preset == compose(["env=bus", "preset=none"]).config.preset == "none"
    assert untuned.algo_config == compose(["env=trivial", "algo=madqn"]).algo_config
    assert untuned.evaluated_env == default.evaluated_env
    assert compose(["experiment=bus_city"]).config.preset == "bus_lines"


def test_the_preset_behind_that_default_changes_the_task_of_no_algorithm() -> None:
    values = yaml.safe_load((configs_folder() / "preset" / "bus_tuned.yaml").read_text())
    assert {key for of_algorithm in values.values() for key in of_algorithm["env"]} == {"training_args"}


@pytest.mark.parametrize("overrides", [(), ("algo=ippo", "seed=0..3", "algo.lr=3e-4")])
def test_without_an_experiment_one_is_asked_for(overrides: tuple[str, ...]) -> None:
    with pytest.raises(HeadwayError, match=r"^no experiment is named; write experiment=NAME") as caught:
        compose(overrides)
    assert "env=NAME and algo=NAME" in str(caught.value)


def test_a_preset_that_was_chosen_is_never_dropped() -> None:
    """The preset may have the name of an environment, or equal the default preset."""
    for words in (["experiment=intersection_paper_ippo"], ["env=bus", "preset=bus_tuned"]):
        with pytest.raises(HeadwayError, match=r"^preset=\w+ has no values for algo=madqn"):
            compose([*words, "algo=madqn"])
    assert compose(["env=intersection_paper", "algo=ippo"]).config.preset == "none"


def test_a_key_is_completed_also_without_an_environment() -> None:
    with pytest.raises(HeadwayError, match=r"did you mean algo\.lr=3e-4\?"):
        compose(["algo=ippo", "lr=3e-4"])


def test_a_value_from_a_file_can_be_removed() -> None:
    short = compose(["experiment=matrix_nine"]).config.rollout
    removed = compose(["experiment=matrix_nine", "~rollout.steps"])
    assert (short.steps, removed.config.rollout) == (16, replace(short, steps=128))
    assert removed == compose(["experiment=matrix_nine", "~rollout.steps=16"])


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("algo.lrr=3e-4", ["algo.lrr is not a key of mappo", "did you mean algo.lr?"]),
        ("algo.learning_rate=3e-4", ["did you mean algo.lr?"]),
        ("algo.discount=0.9", ["did you mean algo.gamma?"]),
        ("algo.cg_damping=1", ["cg_damping is not a key of mappo; it is one of hatrpo, itrpo and matrpo"]),
        ("algo.kfac_every=2", ["kfac_every is not a key of mappo; it is one of algo.critic_update=kfac"]),
        ("algo.double=true", ["algo.double is not a key of mappo; it is one of madqn"]),
        ("rolout.steps=3", ["rolout is not a key", "did you mean rollout?"]),
        ("expriment=toy_tracking", ["did you mean experiment=toy_tracking?", "experiment, preset"]),
        ("nonsense=3", ["nonsense is not a key of the experiment", "experiment", "preset"]),
        ("rollout.stesp=3", ["did you mean rollout.steps?"]),
        ("env.args.agent=3", ["env.args.agent is not a key of trivial", "did you mean env.args.agents?"]),
        ("algo.lr=inf", ["algo.lr must be finite, not inf"]),
        ("algo.model.actor_gain=inf", ["algo.model.actor_gain must be finite, not inf"]),
        ("algo.gamma=2", ["algo.gamma must lie in [0, 1]"]),
        ("algo.model.gru_size=0", ["algo.model.gru_size must be at least 1"]),
        ("algo.model.sequence_length=0", ["algo.model.sequence_length must be at least 1"]),
        ("algo=mapo", ["algo=mapo", "did you mean algo=mappo?"]),
        ("experiment=bus_mapo", ["did you mean experiment=bus_mappo?"]),
        ("experiment=nosuch", ["bus_city, ", " more (headway list experiments)"]),
        ("env=none", ["env=none: there is no such env"]),
        ("env_steps=lots", ["give a whole number, such as 100000"]),
        ("env=trivail", ["did you mean env=trivial?"]),
        ("algo=ippo,mappo", ["choose one option"]),
        ("algo.critic=local", ["'local' is not possible: mappo has critic=central", "algo=ippo", "custom"]),
        ("env.id=bsu", ["unknown environment 'bsu'"]),
        ("algo.name=hatrpo", ["algo.name follows from the choice of algo", "write algo=hatrpo"]),
        ("seed=1..x", ["seed=1..x is not a list of seeds", "0..49"]),
        ("seed=0,-1", ["seed=-1: seeds must not be negative"]),
        ("seed=-1..3", ["seed=-1..3: seeds must not be negative"]),
        ("evaluation.seed=-1", ["evaluation.seed must be at least 0"]),
        ("evaluation.modes=[greedy,sampled,greedy]", ["evaluation.modes must hold each name once"]),
        ("evaluation.rules=[random,random]", ["evaluation.rules must hold each name once"]),
        ("start.kl_coeff=inf", ["start.kl_coeff must be finite, not inf"]),
        ("energy.cpu_power_w=inf", ["energy.cpu_power_w must be finite, not inf"]),
        ("hydra.run.dir=x", ["hydra.run.dir is not a key of the experiment; leave it out"]),
        ("++hydra.run.dir=x", ["hydra.run.dir is not a key of the experiment; leave it out"]),
        ("seed=1,1", ["seed must hold each seed once"]),
        ("~algo.lr=3", ["~algo.lr=3: algo.lr is not set, so its default already applies"]),
        ("~nothing", ["~nothing: nothing is not set"]),
        ("~env=3", ["~env=3: env cannot be removed; choose another option"]),
        ("~", ["'~' is not an override"]),
        ("+=3", ["'+=3' is not an override"]),
        ("+++algo.lr=3", ["'+++algo.lr=3' is not an override"]),
        ("bus_mapo", ["write key=value", "did you mean experiment=bus_mappo?"]),
        ("bus", ["write key=value", "did you mean env=bus?"]),
        ("mappo", ["write key=value", "did you mean algo=mappo?"]),
        ("algo.lr=1e-3,2e-3", ["algo.lr=1e-3,2e-3 lists several values; use `headway sweep`"]),
        ("algo.model.hidden=8,8", ["use `headway sweep`, or algo.model.hidden=[8,8] for one list"]),
        ("algo.model.hidden=64", ["where a list of whole numbers is expected; write algo.model.hidden=[64]"]),
        ("preset=quik", ["preset=quik: there is no such preset"]),
        ("algo.lr=[1,2", ["algo.lr=[1,2 is not valid in Hydra's grammar; close brackets"]),
        ("study='a", ["study='a is not valid in Hydra's grammar"]),
        ("algo.lr=${nowhere}", ["the configuration cannot be composed", "nowhere"]),
        ("env.training_args.stpes=3", ["env.training_args.stpes is not a key", "did you mean"]),
        ("device=gpu", ["device", "cuda"]),
        ("study=2024", ["study=2024 is a whole number", "\"study='2024'\""]),
        ("study='a\tb'", ["study 'a\\tb' has '\\t' in it"]),
    ],
)
def test_bad_input_of_each_kind_is_one_line(override: str, parts: list[str]) -> None:
    with pytest.raises(HeadwayError) as caught:
        compose(["env=trivial", override])
    message = str(caught.value)
    assert "\n" not in message
    assert all(part in message for part in parts), message


def test_several_values_of_a_number_are_not_offered_as_a_list() -> None:
    with pytest.raises(HeadwayError, match=r"use `headway sweep`$"):
        compose(["env=trivial", "algo.lr=1e-3,2e-3"])


def test_rules_of_another_environment_say_how_to_leave_them() -> None:
    words = ["experiment=toy_matrix", "env=visitors"]
    with pytest.raises(HeadwayError, match=r"evaluation\.rules=null selects those of visitors"):
        compose([*words, "evaluation.rules=[optimum]"]).prepare()
    compose([*words, "evaluation.rules=null"]).prepare()


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("evaluation.rules=[optimum]", r"evaluation\.rules: unknown rule 'optimum'; did you mean optimal\?"),
        (
            "evaluation.rules=[lookahead]",
            r"evaluation\.rules: rule lookahead needs an environment that can be",
        ),
        ("env.training_args.agents=3", r"env\.training_args may change rewards and dynamics, not obs"),
    ],
)
def test_what_only_the_environment_can_tell_is_refused_before_the_start(override: str, line: str) -> None:
    experiment = compose(["env=trivial", override])
    with pytest.raises(HeadwayError, match=line):
        experiment.prepare()


def test_lookahead_plays_beside_wrappers_of_rewards_as_without_them() -> None:
    words = ["env=merge", "env.args.steps=4", "evaluation.rules=[lookahead:idle:3:1]"]
    wrapped = "env.wrappers=[{name: scale_reward_v0, scale: 0.5}]"
    plain, beside = (compose([*words, *more]) for more in ((), (wrapped,)))
    rows = []
    for experiment in (plain, beside):
        make = rule_entry(experiment.env, experiment.rules[0]).make
        prepared = experiment.prepare().prepared
        rows.append(evaluate_rule(experiment.env.make, make, prepared, 3, 2))
    assert rows[0] == rows[1]
    with pytest.raises(HeadwayError, match="without wrappers other than reward wrappers"):
        compose([*words, "env.wrappers=[agent_indicator_v0]"]).prepare()


def test_training_arguments_override_environment_arguments() -> None:
    found = compose(["env=bus", "env.args.capacity=50", "env.training_args.reward.scope=own"]).prepare()
    assert found.prepared.config.reward.scope == "team"
    assert found.training.config.reward.scope == "own"
    assert found.prepared.config.capacity == found.training.config.capacity == 50
    assert not found.spec.shared_reward
    same = compose(["env=trivial"]).prepare()
    assert same.training is same.prepared


def test_null_removes_the_training_arguments_of_a_preset() -> None:
    """`{}` would leave them, because mappings are merged."""
    words = ("env=bus", "algo=ippo", "preset=bus_tuned")
    assert compose([*words, "env.training_args={}"]).config.env.training_args
    cleared = compose([*words, "env.training_args=null"])
    assert cleared.training_env_configs[0] == cleared.env_config
    stored = full_mapping(cleared, [0])
    assert stored["env"]["training_args"] == {}
    assert cell_parameters(resolve(stored)) == cell_parameters(cleared)


def test_the_evaluation_environment_is_independent_of_training_settings() -> None:
    plain = compose(["env=trivial"])
    for words in (["env.training_args.steps=9"], ["env.wrappers=[clip_reward_v0]", "algo=ippo"]):
        assert compose(["env=trivial", *words]).evaluated_env == plain.evaluated_env
    spread = ["env=mpe2.simple_spread_v3"]
    assert compose([*spread, "env.max_copies_per_process=4"]).evaluated_env != compose(spread).evaluated_env
    for words in (["env.args.steps=9"], ["env.wrappers=[clip_reward_v0, agent_indicator_v0]"]):
        assert compose(["env=trivial", *words]).evaluated_env != plain.evaluated_env
    assert compose(["env=matrix"]).evaluated_env != plain.evaluated_env


@pytest.mark.parametrize(
    ("study", "line"),
    [
        ("", "study '' has no letter or digit; .* such as study=bus_line"),
        ("..", r"study '\.\.' has no letter or digit"),
        ("a..b", r"study 'a\.\.b' has '\.\.' in it"),
        ("a ", "study 'a ' begins or ends with a blank"),
        ("../elsewhere", r"study '\.\./elsewhere' has '/' in it"),
        ("a\\b", "in it"),
        ("a\x1b[1mb", r"study 'a\\x1b\[1mb' has '\\x1b' in it"),
        ("a" * 101, r"study 'aaaaaaaaaaaaaaaaaaaa'\.\.\. is longer than 100"),
    ],
)
def test_study_names_that_are_no_folder_names_are_refused(study: str, line: str) -> None:
    for accepted in ("bus", "bus line 2", "étude-1.0_b"):
        assert build(ExperimentConfig, {"study": accepted}).study == accepted
    with pytest.raises(HeadwayError, match=line):
        build(ExperimentConfig, {"study": study})


def test_by_default_all_rules_of_the_environment_are_played() -> None:
    experiment = compose(["env=trivial"])
    assert experiment.rules == ("random", "optimal")
    # Written out, so that a rule added later changes no stored run.
    assert full_mapping(experiment, ())["evaluation"]["rules"] == ["random", "optimal"]
    assert compose(["env=trivial", "evaluation.rules=[]"]).rules == ()
    assert compose(["env=trivial", "evaluation.rules=[optimal]"]).rules == ("optimal",)


def test_a_stored_configuration_gives_the_same_experiment() -> None:
    words = ["env=trivial", "preset=paper", "seed=0..3", "env.training_args.steps=9", "rollout.steps=512"]
    experiment = compose(words)
    again = resolve(full_mapping(experiment, [2]))
    assert again.config.rollout == experiment.config.rollout == RolloutConfig(10, 512, 5)
    assert again.algo_config == experiment.algo_config
    assert again.env_config == experiment.env_config
    assert again.training_env_configs[0] == experiment.training_env_configs[0] != experiment.env_config
    assert again.config.seed == (2,)
    assert cell_parameters(again) == cell_parameters(experiment)


def test_every_key_has_a_docstring() -> None:
    records = [entry.config for entry in (*algo_entries().values(), *env_entries().values())]
    for record in (ExperimentConfig, *records):
        for key in describe(record):
            assert key.doc, f"{record.__name__}.{key.key} has no docstring"


PAPERS = ("ia2c", "ippo", "itrpo", "maa2c", "coma", "mappo", "matrpo", "happo", "hatrpo")


@pytest.mark.parametrize(
    "algorithm", quick_or_slow({name: (name,) for name in PAPERS}, "ia2c", "coma", "hatrpo")
)
def test_the_papers_preset_has_values_for_its_nine_algorithms(algorithm: str) -> None:
    experiment = compose(["env=trivial", f"algo={algorithm}", "preset=paper"])
    assert experiment.algo_config.model.hidden == (128, 128)
    assert experiment.algo_config.gae_lambda == 1.0
    assert experiment.config.rollout.copies * experiment.config.rollout.steps == 1000
    experiment.prepare()


@pytest.mark.parametrize(
    ("env", "preset", "algorithm"),
    pairwise(
        ["merge", "merge_two_lane"], ["merge_paper", "merge_tuned"], ["mappo", "ippo", "maacktr", "madqn"]
    ),
)
def test_the_merging_study_has_values_for_its_algorithms(algorithm: str, preset: str, env: str) -> None:
    experiment = compose(["experiment=merge_study", f"algo={algorithm}", f"preset={preset}", f"env={env}"])
    experiment.prepare()
    config, algo = experiment.config, experiment.algo_config
    assert algo.policies == "shared"
    assert config.evaluation.every == 20 * 100
    assert config.env_steps == 10_000 * 100
    assert not experiment.env_config.supervisor
    # Whatever reward trains them, the evaluation reports the mean of all agents.
    assert experiment.env_config.reward.scope == "global"
    if preset == "merge_paper":
        assert (algo.gamma, algo.model.hidden, algo.model.activation) == (0.99, (128, 128), "relu")
        assert config.rollout.copies * config.rollout.steps == 100
        assert not algo.normalise_observations
        assert experiment.training_env_configs[0].reward.scope == {"mappo": "global", "ippo": "global"}.get(
            algorithm, "regional"
        )


def test_one_sweep_covers_the_merging_study() -> None:
    """All its cells in one study; with and without supervisor are separate environments."""
    words = ["experiment=merge_study", "algo=mappo,madqn", "env=merge,merge_two_lane"]
    cells = compose_sweep([*words, "env.args.supervisor=false,true"])
    assert len(cells) == len(distinct(cells)) == 8
    assert {cell.config.study for cell in cells} == {"merge_study"}
    assert len({json.dumps(cell.evaluated_env, sort_keys=True) for cell in cells}) == 4


def test_an_unnamed_composition_runs_as_custom() -> None:
    """HAA2C for example; what its order refuses is refused before anything starts."""
    composed = compose(
        ["env=trivial", "algo=custom", "algo.critic=central", "algo.update=a2c", "algo.order=sequential"]
    )
    composed.prepare()
    with pytest.raises(
        HeadwayError, match=r"algo\.policies=shared gives only one on trivial; use algo\.policies=independent"
    ):
        compose(["env=trivial", "algo=custom", "algo.order=sequential", "algo.policies=shared"]).prepare()


@cache
def _of_study(option: str) -> ExperimentConfig:
    return compose([f"experiment={option}"]).config


@pytest.mark.parametrize("option", options()["experiment"])
def test_every_experiment_composes_and_has_a_summary(option: str) -> None:
    assert summary_of("experiment", option).endswith(".")
    assert _of_study(option).study


@pytest.mark.parametrize("name", quick_or_slow({name: (name,) for name in options()["search"]}, "bus_trpo"))
def test_every_search_is_valid_on_seeds_that_no_study_reports(name: str) -> None:
    reported = {seed for option in options()["experiment"] for seed in _of_study(option).seed}
    for part in read_search(name):
        assert reported.isdisjoint(part.search.training_seeds)
        assert part.experiment(0, corners(part.space)[-1]).config.study == f"search_{name}"


def test_jobs_are_stacks_of_seeds_in_order() -> None:
    jobs = plan_jobs(compose(["env=trivial", "seed=0..4", "backend.stack=2"]))
    assert [job.seeds for job in jobs] == [(0, 1), (2, 3), (4,)]


def test_cores_go_to_training_processes_first() -> None:
    experiment = compose(["env=trivial"])
    for seeds, cores, expected in (
        (50, 16, CoreShares(16, 1)),
        (4, 16, CoreShares(4, 4)),
        (1, 2, CoreShares(1, 2)),
    ):
        jobs = new_jobs(experiment, range(seeds))
        assert share_cores(experiment.config.backend, jobs, cores) == expected


def test_the_summary_of_a_file_is_the_first_sentence_of_its_comment() -> None:
    assert summary_of("experiment", "toy_recall").endswith("with algo.model.core=none it stays at chance.")
    assert summary_of("experiment", "merge_mappo").endswith("beside rules and human drivers.")
    assert summary_of("preset", "bus_tuned").endswith("need separate policies).")


@pytest.mark.parametrize(
    ("uri", "without"),
    [
        ("http://me:secret@host:5000", "http://me@host:5000"),
        ("postgresql://me:se/secret@host/db", "postgresql://me@host/db"),
        ("mysql+pymysql://host/db?user=me&password=secret&ssl=1", "mysql+pymysql://host/db?user=me&ssl=1"),
    ],
)
def test_a_password_in_the_tracking_uri_is_refused_and_not_shown(uri: str, without: str) -> None:
    """It would be stored in every run's folder and sent to MLflow; a run stored with one can be resumed."""

    def words(of: str) -> list[str]:
        return ["env=trivial", "algo=ippo", f"++store.tracking_uri='{of}'"]

    with pytest.raises(HeadwayError, match=r"store\.tracking_uri must hold no password") as refusal:
        compose(words(uri))
    assert "secret" not in str(refusal.value)
    mapping = full_mapping(compose(words(without)), [0])
    stored = {**mapping, "store": {**mapping["store"], "tracking_uri": uri}}
    assert resolve(upgraded(stored)).config.store.tracking_uri == without


def test_an_at_sign_in_a_query_is_no_password() -> None:
    compose(["env=trivial", "algo=ippo", "++store.tracking_uri='http://host:5000?mail=me@host'"])


@pytest.mark.parametrize(
    ("environment", "rule"),
    [
        ("merge", "idm_mobil"),
        ("intersection", "human"),
        ("intersection", "human_mode1"),
        ("junctions", "human"),
        ("junctions", "human_mode1"),
        ("junctions", "signal"),
        ("junctions", "signal_best"),
        ("junctions", "max_pressure"),
    ],
)
def test_training_does_not_start_from_rules_whose_actions_drive_no_vehicle(
    environment: str, rule: str
) -> None:
    """Policies would imitate placeholders: the simulator drives under these rules."""
    with pytest.raises(HeadwayError, match=f"'{rule}' is not a rule of {environment} to start from"):
        require_rule(rule, environment, env_entries()[environment])
