"""Files of searches and of search spaces, and the candidates that they describe."""

from collections.abc import Callable
from pathlib import Path

import pytest

from headway.config.schema import plain
from headway.contracts.errors import HeadwayError
from headway.registry import algo_entries
from headway_launch.experiments.compose import compose
from headway_launch.experiments.options import options, own_configs
from headway_launch.experiments.search import EVALUATION_SEED, AlgorithmSearch, read_search
from headway_launch.experiments.search_space import candidate_overrides, corners, dimensions, read_piece

BASE = "base: [env=trivial]\nalgorithms: {ippo: []}\ncandidates: 4\nenv_steps: 4_096\n"
Written = Callable[..., list[AlgorithmSearch]]


@pytest.fixture
def written(tmp_path: Path) -> Written:
    """Write a search to a folder of its own and read it, with overrides."""

    def read(text: str, *overrides: str, **pieces: str) -> list[AlgorithmSearch]:
        for name, content in {"search/mine": text, **{f"space/{key}": pieces[key] for key in pieces}}.items():
            file = tmp_path / f"{name}.yaml"
            file.parent.mkdir(exist_ok=True)
            file.write_text(content)
        with own_configs(str(tmp_path)):
            return read_search("mine", overrides)

    return read


def test_spaces_are_composed_of_the_pieces_that_algorithms_have(written: Written) -> None:
    """The search's own dimensions replace those of pieces."""
    text = BASE.replace(
        "{ippo: []}", "{ippo: [], itrpo: [algo.gamma=0.9], apart: [algo=itrpo, algo.gamma=0.8]}"
    )
    parts = written(f"{text}pieces: [ppo, trpo]\nspace: {{algo.lr: [1e-3, 2e-3]}}\n")
    assert {part.label: list(part.space) for part in parts} == {
        "ippo": ["algo.lr", "algo.epochs", "algo.minibatches", "algo.clip"],
        "itrpo": ["algo.kl_bound", "algo.lr"],
        "apart": ["algo.kl_bound", "algo.lr"],
    }
    values = {"algo.kl_bound": 0.5, "algo.lr": "0.002"}
    _, itrpo, apart = (part.experiment(3, values | corners(part.space)[0] | values) for part in parts)
    assert (itrpo.algo_config.kl_bound, itrpo.algo_config.lr, itrpo.algo_config.gamma) == (0.5, 0.002, 0.9)
    assert (apart.algo_name, apart.algo_config.gamma) == ("itrpo", 0.8)
    config = itrpo.config
    assert (config.study, config.seed, config.env_steps) == ("search_mine", (9001,), 4096)
    assert (config.candidate, config.evaluation.seed, config.evaluation.rules) == (
        "candidate 3",
        EVALUATION_SEED,
        (),
    )


def test_overrides_set_keys_of_the_search_and_of_its_runs(written: Written) -> None:
    [part] = written(
        f"{BASE}pieces: [ppo]\n", "candidates=6", "rungs=[50_000,60_000]", "env_steps=1e5", "seeds=2",
        "algo.gamma=0.5",
    )  # fmt: skip
    assert (part.search.candidates, part.search.rungs, part.search.seeds) == (6, (50_000, 60_000), 2)
    experiment = part.experiment(0, corners(part.space)[0])
    assert (experiment.config.env_steps, experiment.algo_config.gamma) == (100_000, 0.5)
    assert experiment.config.seed == (9001, 9002)


def test_the_budget_of_halving_is_that_of_its_rungs(written: Written) -> None:
    text = f"{BASE}seeds: 2\nbatch: 5\nrungs: [1_000, 2_000]\npieces: [ppo]\n"
    [part] = written(text, "candidates=10", "evaluation.every=1_000")
    # Two batches of five: five to step 1,000, three to 2,000, two to the end.
    assert part.search.left_at(5) == [5, 3, 2]
    assert part.steps() == 2 * 2 * (5 * 1_000 + 3 * 1_000 + 2 * (4_096 - 2_000))
    assert part.batches == [range(5), range(5, 10)]


def test_dimensions_are_ranges_lists_or_named_overrides() -> None:
    space = dimensions(
        {
            "algo.lr": {"low": 0.001, "high": 0.1, "log": True},
            "algo.epochs": {"low": 2, "high": 8, "step": 3},
            "algo.model.hidden": [[64, 64], [128]],
            "reward": {"own": ["env.training_args.reward={scope:own}", "algo.gamma=0.9"], "none": []},
        },
        "space",
    )
    assert [place.get("algo.epochs") for place in corners(space)] == [2, 8, 2]
    values = {"algo.lr": 0.01, "algo.epochs": 5, "algo.model.hidden": "[128]", "reward": "own"}
    assert candidate_overrides(space, values) == (
        "env.training_args.reward={scope:own}", "algo.gamma=0.9",
        "algo.lr=0.01", "algo.epochs=5", "algo.model.hidden=[128]",
    )  # fmt: skip
    assert space["algo.epochs"].grid("algo.epochs") == (2, 5, 8)


ONE = f"{BASE}space: {{algo.lr: [1e-3, 2e-3]}}\n"


def space(text: str) -> str:
    return f"{BASE}space: {{{text}}}\n"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "base is missing"),
        ("base: [", "is not valid YAML"),
        (BASE, "ippo has nothing to search"),
        (space(""), "ippo has nothing to search"),
        (f"{BASE}pieces: [trpo]\n", "no dimension in space, and none of pieces (trpo) is one of ippo"),
        (f"{BASE}pieces: [pppo]\n", "there is no space 'pppo'; did you mean ppo?"),
        (f"{ONE}pieces: [trpo]\n", "no algorithm of this search has the piece trpo"),
        (space("algo.lr: []"), "space.algo.lr is empty"),
        (space("algo.lr: 3"), "space.algo.lr is empty or no dimension"),
        (space("algo.lr: {low: 2, high: 1}"), "algo.lr.low must be below high=1, not 2"),
        (space("algo.lr: {low: 0, high: 1, log: true}"), "log needs low above 0"),
        (space("3: [1, 2]"), "space has the key 3, which is not text; write it in quotes"),
        (ONE.replace("ippo", "3"), "algorithms has the key 3, which is not text"),
        (space("algo.epochs: {low: 1, high: 4, step: 0.5}"), "ippo: algo.epochs=1.5 is a number"),
        (space("algo.epochs: {low: 1.0, high: 4.0}"), "where a whole number is expected"),
        (space("algo.lr: {low: 0, hihg: 1}"), "did you mean search/mine.space.algo.lr.high?"),
        (space("algo.lr: [1, 1]"), "lists a value twice"),
        (space("algo.kl_bound: [0.1, 0.2]"), "ippo: algo.kl_bound"),
        (space("env.args.steps: [8, 9]"), "env.args.steps cannot be searched"),
        (space("length: {long: [env_steps=9]}"), "env_steps=9 cannot be searched"),
        (f"{ONE}sampler: tep\n", "sampler='tep' is not possible; did you mean tpe?"),
        (f"{ONE}sampler: tpe\n", "batch must be set, below candidates"),
        (f"{ONE}batch: 3\n", "batch of 3 must divide candidates (4)"),
        (f"{ONE}rungs: [2_000, 1_000]\n", "rungs must ascend"),
        (f"{ONE}rungs: [4_096]\n", "rungs must ascend, between 0 and env_steps"),
        (f"{ONE}rungs: [1_000]\n", "rungs: after 1,000 steps there is no evaluation yet"),
        (f"{ONE}metric: retrun\n", "metric=retrun: no such metric; did you mean return?"),
        (f"{ONE}metric: evaluation_sample/return\n", "needs evaluation_sample, and evaluation.modes has"),
        (ONE.replace("4", "0", 1), "candidates must be at least 1, not 0"),
        (ONE.replace("4_096", "0"), "env_steps must be at least 1, not 0"),
        (ONE.replace("trivial", "trivail"), "trivail"),
        (ONE.replace("{ippo: []}", "{}"), "algorithms must name at least one algorithm"),
        (ONE.replace("ippo", "ipo"), "no algorithm 'ipo'; did you mean ippo?"),
        (ONE.replace("=trivial", "=trivial, seed=7"), "seed=7: candidates train on seeds from 9001 on"),
        (space("algo.lr: [1, 2, 3], algo.gamma: [0, 1]") + "sampler: grid", "grid of ippo has 6 candidates"),
        (space("algo.lr: {low: 0.1, high: 1}") + "sampler: grid", "algo.lr is a range without step"),
        (f"{ONE}budget: 3\n", "budget is not a key of search/mine"),
    ],
)  # fmt: skip
def test_a_bad_search_is_one_line(text: str, line: str, written: Written) -> None:
    with pytest.raises(HeadwayError) as raised:
        written(text)
    assert line in str(raised.value)
    assert "\n" not in str(raised.value)


def test_bad_pieces_and_overrides_are_one_line(written: Written) -> None:
    for overrides, line in (
        (["algo.lr=0.1"], "algo.lr=0.1: the search has this key in its space"),
        (["stages=[]"], "stages=[]: the steps of a candidate"),
        (["candidates=[1"], "is not valid YAML"),
        (["store.roots=x"], "store.roots"),
    ):
        with pytest.raises(HeadwayError) as raised:
            written(ONE, *overrides)
        assert line in str(raised.value)
    with pytest.raises(HeadwayError, match="no algorithm 'ipo'; did you mean ippo"):
        written(f"{BASE}pieces: [own]\n", own="algorithms: [ippo, ipo]\nspace: {algo.lr: [1, 2]}")


def test_seeds_that_the_experiment_reports_are_refused(written: Written, tmp_path: Path) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "ours.yaml").write_text("env: trivial\nseed: 9002\n")
    text = ONE.replace("env=trivial", "experiment=ours")
    assert written(text)
    with pytest.raises(HeadwayError, match="reports seed 9002, on which candidates are trained"):
        written(f"{text}seeds: 2\n")


@pytest.mark.parametrize("name", options()["space"])
def test_every_piece_is_one_of_its_algorithms(name: str) -> None:
    piece = read_piece(name)
    space = dimensions(piece.space, name)
    for algorithm in piece.algorithms:
        for values in corners(space)[:2]:
            compose(["env=trivial", f"algo={algorithm}", *candidate_overrides(space, values)])


def test_every_algorithm_with_a_name_has_pieces() -> None:
    covered = {algorithm for name in options()["space"] for algorithm in read_piece(name).algorithms}
    assert covered == set(algo_entries()) - {"custom"}


def test_equal_settings_are_equal_whatever_the_number_of_candidates(written: Written) -> None:
    """A search without rungs can be continued with more candidates."""
    few, more = (written(ONE, f"candidates={count}")[0].settings for count in (4, 8))
    assert few == more
    rungs = f"{ONE}rungs: [40_000]\n"
    few, more = (written(rungs, f"candidates={count}", "env_steps=50_000")[0].settings for count in (4, 8))
    assert few != more
    assert plain(few)["batch"] == 4
