"""Experiments outside the project: a file at any path, a folder of groups, a run's stored configuration."""

from pathlib import Path

import pytest
import yaml
from command_lines import output, refused, rows_of
from small_runs import SMALL

from headway.config.experiment import ExperimentConfig
from headway.config.schema import plain
from headway.store.index import RunIndex
from headway_launch.commands.main import run
from headway_launch.experiments.compose import compose
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.options import own_configs
from headway_launch.experiments.parameters import cell_parameters, full_mapping, identity
from headway_launch.experiments.search import read_search
from headway_launch.experiments.search_space import corners
from headway_launch.experiments.sweep import compose_sweep

MINE = """
# Ours.
env: merge
algo: mappo
preset: merge_tuned
study: ours
seed: 0..2
env_steps: 3e4
algo_config: &lr {lr: 1e-3}
"""
OURS = """\
# Trains quickly.
defaults:
  - override /env: tracking
  - override /algo: ippo
  - override /preset: quick

env_steps: 128
"""
QUICK = "ippo: {algo: {lr: 0.002}, rollout: {copies: 4, block: 2}}\n"
SEARCH = """\
base: [experiment=ours]
algorithms: {ippo: []}
candidates: 2
env_steps: 128
space: {algo.lr: [1, 2]}
"""


def written(path: str, text: str) -> Path:
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


@pytest.fixture
def folder(empty_folder: Path) -> str:
    """Folder of configurations with an experiment, its preset and a search."""
    written("our lab/experiment/ours.yaml", OURS)
    written("our lab/preset/quick.yaml", QUICK)
    written("our lab/search/rates.yaml", SEARCH)
    written("our lab/data/notes.yaml", "no: group")
    return "our lab"


BOMB = "".join(
    f"k{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10) if level else '0'}]\n" for level in range(9)
)
"""Ten times as much per level."""


def lr(experiment: Experiment) -> float:
    return float(experiment.algo_config.lr)


@pytest.mark.usefixtures("empty_folder")
def test_a_file_is_an_experiment_like_those_of_the_project() -> None:
    """Its groups may be given by name; overrides have precedence, also over the choice of a group."""
    text = MINE.replace("algo_config: &lr {lr: 1e-3}", "evaluation: {rules: []}")
    file = str(written("some where/mine.yml", text))
    experiment = compose([file])
    words = ["env=merge", "algo=mappo", "preset=merge_tuned", "study=ours", "seed=0..2", "env_steps=3e4"]
    same = compose([*words, "evaluation.rules=[]"])
    assert full_mapping(experiment, (0,)) == full_mapping(same, (0,))
    assert experiment.config.seed == (0, 1, 2)
    assert not compose([str(written("off.yaml", f"{text}\nenergy: off\n"))]).config.energy.enabled
    changed = compose([file, "algo=ippo", "algo.lr=0.5", "seed=7"])
    assert (changed.algo_name, lr(changed), changed.config.seed) == ("ippo", 0.5, (7,))
    swept = compose_sweep([file, "algo=ippo,mappo", "algo.lr=0.1,0.2"])
    assert [(each.algo_name, lr(each)) for each in swept] == [
        ("ippo", 0.1), ("ippo", 0.2), ("mappo", 0.1), ("mappo", 0.2),
    ]  # fmt: skip


def test_files_of_the_project_can_be_given_by_path() -> None:
    configs = Path(__file__).parents[3] / "configs" / "experiment"
    for name in ("bus_mappo", "mpe2_spread"):
        by_path, by_name = compose([str(configs / f"{name}.yaml")]), compose([f"experiment={name}"])
        assert full_mapping(by_path, (0,)) == full_mapping(by_name, (0,))


PATHS = """
env:
  id: ./shuttle.py
  args: {cars: data/cars, fare: my.fare, steps: four, names: [data/cars, mpe2.other]}
  training_args: {fare: ../other.fare}
stages: [{env_steps: 2048, training_args: {fare: my.fare}}, {env_steps: 2048}]
algo: ippo
"""
SHUTTLE_OF_PATHS = """
from pettingzoo.test.example_envs import generated_agents_parallel_v0


def parallel_env(cars="", fare="", steps="", names=()):
    return generated_agents_parallel_v0.parallel_env()
"""


@pytest.mark.parametrize("option", [False, True])
def test_a_path_that_is_not_in_the_current_folder_is_beside_the_file(
    option: bool, empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stored paths are then absolute, so that the run is continued from any folder. A name of packaged
    data (four) is no path."""
    lab = empty_folder / "lab" / "experiment"
    for name in ("data/cars", "my.fare", "four", "../other.fare"):
        written(f"{lab}/{name}", "")
    written(f"{lab}/shuttle.py", SHUTTLE_OF_PATHS)
    file = written(f"{lab}/paths.yaml", PATHS)

    def composed(*words: str) -> ExperimentConfig:
        if not option:
            return compose([str(file), *words]).config
        with own_configs(str(empty_folder / "lab")):
            return compose(["experiment=paths", *words]).config

    env = composed().env
    assert env.id == f"{lab}/shuttle.py"
    assert env.args == {
        "cars": f"{lab}/data/cars", "fare": f"{lab}/my.fare", "steps": "four",
        "names": [f"{lab}/data/cars", "mpe2.other"],
    }  # fmt: skip
    assert env.training_args == {"fare": str(empty_folder / "lab" / "other.fare")}
    assert composed().stages[0].training_args == {"fare": f"{lab}/my.fare"}
    assert composed("env.args.fare=data/cars").env.args["fare"] == "data/cars"
    # What exists in the current folder is meant as before.
    written("data/cars", "")
    written("shuttle.py", SHUTTLE_OF_PATHS)
    assert composed().env.args["cars"] == "data/cars"
    assert composed().env.id == f"{empty_folder}/shuttle.py"
    monkeypatch.chdir(lab)
    assert composed().env.args["fare"] == "my.fare"


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("env", ["./shuttle.py", "{id: ./shuttle.py}"])
def test_the_command_line_chooses_another_environment_than_a_file_s_own(env: str) -> None:
    for name in ("shuttle.py", "other.py"):
        written(name, SHUTTLE_OF_PATHS)
    file = str(written("mine.yaml", f"env: {env}\nalgo: ippo\nenv_steps: 2048\n"))
    assert compose([file]).config.env.id == str(Path("shuttle.py").absolute())
    assert compose([file, "env=trivial"]).config.env.id == "trivial"
    assert compose([file, "env=./other.py"]).config.env.id == str(Path("other.py").absolute())


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "must hold keys of an experiment, such as env: bus"),
        ("[env, bus]", "must hold keys of an experiment"),
        ("1: 2", "must hold keys of an experiment"),
        ("env: [", "bad.yaml is not valid YAML: "),
        (
            "env: a: b",
            "bad.yaml is not valid YAML: mapping values are not allowed in this context, line 1, c",
        ),
        ("\0", "bad.yaml is not valid YAML: "),
        ("[" * 5000, "bad.yaml is not valid YAML: "),
        ("env: ${nothing}", "nothing"),
        ("env: trivial\nalgo: mapo", "bad.yaml: there is no algo 'mapo'; did you mean mappo?"),
        (
            "env: trivial\nalgo: [mappo, ippo]",
            "bad.yaml: algo takes one name; write algo: NAME, and `headway sweep bad.yaml algo=mappo,ippo` "
            "trains several",
        ),
        ("env: [trivial, merge]", "and `headway sweep bad.yaml env=trivial,merge` trains"),
        ("env: trivial\ndefaults: {a: b}", "bad.yaml: defaults must be a list"),
        ("env: trivial\ndefaults: [override /algo: mapo]", "mapo"),
        (
            "env: trivial\nalgo: ippo\nsede: 3",
            "bad.yaml: sede is not a key of the experiment; did you mean seed?",
        ),
        (
            "env: merge\nargs: {density: 2}",
            "bad.yaml: args is not a key of the experiment; did you mean env.args?",
        ),
        (
            "env: {id: merge, density: 2}",
            "bad.yaml: env.density is not a key of env; did you mean env.args.density?",
        ),
        (
            "env: merge\ndensity: 2",
            "bad.yaml: density is not a key of the experiment; did you mean env.args.density?",
        ),
        (
            "env: merge\nalgo: {name: mappo, lrr: 1}",
            "bad.yaml: algo.lrr is not a key of mappo; did you mean algo.lr?",
        ),
        ("env: trivial\nalgo: {name: ippo, lr: high}", "algo.lr='high' is text, where a number is expected"),
        ("env: trivial\nstudy: {_target_: os.system}", "_target_"),
        ("algo: ippo", "no experiment is named"),
        ("env: trivial\nhydra: {verbose: true}", "bad.yaml: hydra is not a key of an experiment; remove it"),
        (
            "algo: mappo\nalgo.lr: 1",
            "algo.lr: keys of a file are nested; write algo: {name: NAME, lr: VALUE}",
        ),
        ("env: bus\nenv.args.a.b: 1", "are nested; write env: {id: NAME, args: {a: {b: VALUE}}}"),
        (BOMB, "it has more than 100,000 nodes, aliases written out"),
    ],
)
def test_a_bad_file_is_one_line(text: str, line: str) -> None:
    assert line in refused("run", str(written("bad.yaml", text)))


@pytest.mark.parametrize("form", ["env: ./no.py", "env: {id: ./no.py}"])
def test_an_environment_s_file_is_missing_in_the_current_folder_and_beside_the_experiment(
    form: str, empty_folder: Path
) -> None:
    written("lab/mine.yaml", f"{form}\nalgo: ippo\n")
    absent = f"headway: env.id={empty_folder}/no.py: there is no such file"
    line = refused("run", "lab/mine.yaml")
    assert line.startswith(f"{absent}, nor one beside lab/mine.yaml; correct the path")
    assert refused("run", "lab/mine.yaml", "env=./no.py").startswith(f"{absent}; correct the path")


def test_an_unknown_key_of_the_command_line_is_not_said_to_be_the_file_s(empty_folder: Path) -> None:
    written("mine.yaml", "env: merge\nalgo: mappo\n")
    line = refused("run", "mine.yaml", "env.density=2")
    assert line == "headway: env.density is not a key of env; did you mean env.args.density?\n"


def test_no_file_and_two_experiments_are_one_line(empty_folder: Path) -> None:
    assert "no.yaml: there is no such file; give an experiment's YAML file" in refused("run", "no.yaml")
    Path("folder.yaml").mkdir()
    assert "folder.yaml: there is no such file" in refused("sweep", "folder.yaml")
    written("mine.yaml", "env: trivial\nalgo: ippo\n")
    for other in ("experiment=bus_mappo", "folder.yaml"):
        assert f"mine.yaml and {other} are several experiments" in refused("run", "mine.yaml", other).replace(
            "folder.yaml and mine.yaml", "mine.yaml and folder.yaml"
        )


def test_an_environment_as_a_word_is_named_with_its_key(empty_folder: Path) -> None:
    written("own/shuttle.py", "")
    assert "did you mean env=./own/shuttle.py?" in refused("run", "own/shuttle.py")


@pytest.mark.parametrize("form", ["preset: quick", "defaults: [override /preset: quick]"])
def test_a_preset_of_a_folder_that_was_not_given_is_named_with_it(form: str, folder: str) -> None:
    file = written(f"{folder}/experiment/other.yaml", f"env: tracking\nalgo: ippo\n{form}\n")
    assert f"no preset 'quick'; --config-dir {folder} would know it" in refused("run", str(file))


@pytest.mark.slow
def test_a_stored_configuration_trains_again(folder: str) -> None:
    """It trains in the same cell, also if its preset no longer exists, and with other values."""
    words = ["experiment=ours", *SMALL, "env.args.steps=8"]
    assert run(["run", "--config-dir", folder, *words, "seed=3"]) == 0
    [first] = RunIndex(Path("runs")).rows()
    assert (first.preset, first.seed) == ("quick", 3)
    # Without the folder.
    assert run(["evaluate", first.run_id, "--episodes=1"]) == 0
    stored = str(Path(first.directory, "config.yaml"))
    mapping = yaml.safe_load(Path(stored).read_text())
    again = compose([stored])
    assert identity(full_mapping(again, [3])) == identity(mapping)
    assert plain(again.config.rollout) == mapping["rollout"]
    assert lr(again) == 0.002
    assert lr(compose([stored, "algo.lr=0.5"])) == 0.5
    output("run", stored, "seed=4")
    assert len({row.cell for row in RunIndex(Path("runs")).rows()}) == 1


def test_a_folder_adds_to_all_commands_that_compose(folder: str) -> None:
    with own_configs(folder):
        experiment = compose(["experiment=ours"])
        assert (experiment.config.preset, lr(experiment)) == ("quick", 0.002)
        assert lr(compose(["env=trivial", "algo=ippo", "preset=quick"])) == 0.002
        [part] = read_search("rates")
        assert [lr(part.experiment(0, values)) for values in corners(part.space)] == [1.0, 2.0]
        swept = compose_sweep(["experiment=ours", "preset=quick,none"])
        assert [each.config.preset for each in swept] == ["quick", "none"]
    option = f"--config-dir={folder}"
    assert ["ours", "Trains quickly."] in rows_of("list", "experiments", option)
    assert output("list", "presets", "quick", option).out == QUICK
    assert ["ours", "Trains quickly."] not in rows_of("list", "experiments")
    words = ("--slurm", "--cpus=2", "seed=0", f"store.root={Path.cwd()}")
    script = Path(output("sweep", "experiment=ours", option, *words, "--array").out.strip()).read_text()
    assert f"--config-dir={Path(folder).resolve()}" in script


def test_bad_folders_are_one_line(folder: str) -> None:
    Path("empty").mkdir()
    for name, problem in {
        "empty": " has no YAML files in a folder",
        "our lab/data": " has no YAML files in a folder",
        "nowhere": ": there is no such folder",
        "our lab/experiment/ours.yaml": ": there is no such folder",
    }.items():
        assert f"--config-dir {name}{problem}" in refused("run", "--config-dir", name, "experiment=ours")
    given = ("run", "--config-dir", folder)
    assert "did you mean experiment=ours?" in refused(*given, "experiment=our")
    assert "there is no such experiment" in refused("run", "experiment=ours")
    written(f"{folder}/experiment/ours.yaml", "env: [")
    assert "ours.yaml is not valid YAML" in refused(*given, "experiment=ours")
    written(f"{folder}/experiment/deep/ours.yaml", "env: trivial\nalgo: ippo\npreset: slow")
    assert "there is no preset 'slow'" in refused(*given, "experiment=deep/ours")
    written(f"{folder}/preset/quick.yaml", "ippo: [")
    assert "preset/quick.yaml" in refused(*given, "env=trivial", "algo=ippo", "preset=quick")
    written(f"{folder}/experiment/bus_mappo.yaml", OURS)
    line = refused(*given, "experiment=bus_mappo")
    assert "bus_mappo.yaml: Headway's own experiment has this name; choose another" in line


def test_parameters_of_a_cell_do_not_name_the_file(empty_folder: Path) -> None:
    """A cell is the same, whatever file it was described in."""
    for name in ("one.yaml", "other.yaml"):
        written(name, "env: trivial\nalgo: ippo\n")
    assert cell_parameters(compose(["one.yaml"])) == cell_parameters(compose(["other.yaml"]))
