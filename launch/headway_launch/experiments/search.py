"""Hyper-parameter searches: the files of configs/search and the experiments of their candidates."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from math import ceil, prod
from typing import Any, Literal

from headway.config.experiment import ExperimentConfig
from headway.config.schema import build, plain, suggestion
from headway.contracts.checks import require_at_least, require_key, require_value
from headway.contracts.errors import HeadwayError
from headway.registry import algo_entries
from headway_launch.experiments.compose import compose, composer
from headway_launch.experiments.experiment import Experiment, PreparedEnv
from headway_launch.experiments.options import config_file, options
from headway_launch.experiments.parameters import flat, full_mapping, identity
from headway_launch.experiments.search_space import (
    Space,
    Value,
    candidate_settings,
    chosen_overrides,
    corners,
    dimensions,
    grid,
    names_of_choices,
    read_piece,
)
from headway_launch.experiments.sweep import require_one_session
from headway_launch.experiments.yaml_file import read_mapping

FIRST_SEED = 9_001
"""First training seed of candidates, which no study may report."""
EVALUATION_SEED = 3_000_017
"""Root of the evaluation seeds of candidates: their episodes are not those on which studies are evaluated."""
_OF_ALL_EPISODES = ("return", "length")
"""Metrics of the episodes of all environments."""
_REFUSED = {
    "seed": f"candidates train on seeds from {FIRST_SEED} on, which no study reports; seeds is their number",
    "env_steps": "the steps of a candidate are the search's own key env_steps",
    "stages": "the steps of a candidate are the search's own key env_steps, in one stage",
    "evaluation.rules": "a search plays no rules",
}
"""Overrides that a search refuses, with the reason."""


@dataclass(frozen=True)
class Search:
    """A hyper-parameter search: the contents of a file in configs/search."""

    base: tuple[str, ...]
    """Overrides of every run, including `experiment=...` or `env=...`."""
    algorithms: Mapping[str, tuple[str, ...]]
    """Algorithms that are compared, each with overrides of its own: `{ippo: [], mappo: [algo.epochs=4]}`.
    Another name than the algorithm's needs `algo=...` among them."""
    candidates: int
    """Candidates per algorithm."""
    env_steps: int
    """Environment steps per candidate and seed, if it is trained to the end."""
    pieces: tuple[str, ...] = ()
    """Files of configs/space. Each adds its dimensions to those algorithms that have this piece."""
    space: Mapping[str, Any] = field(default_factory=dict)
    """Further dimensions, of every algorithm, which replace those of pieces with the same key:
    `{low: 1.0e-4, high: 1.0e-2, log: true}`, a list of values, or named lists of overrides."""
    sampler: Literal["random", "tpe", "grid"] = "random"
    """Optuna's sampler. `tpe` draws a batch by the scores of the batches before; the first one is random.
    `grid` tries every combination of values, in random order."""
    sampler_seed: int = 0
    """Seed of the sampler. With the same seed the same candidates are drawn."""
    batch: int | None = None
    """Candidates of each algorithm that are drawn and trained together. null: all."""
    rungs: tuple[int, ...] = ()
    """Environment steps after which only the best part of a batch is continued (successive halving); []: all
    candidates are trained to the end."""
    keep: float = 0.5
    """Share of a batch that is continued after each rung, rounded up."""
    seeds: int = 1
    """Training seeds per candidate: 9001, 9002 and so on. A candidate's score is the mean over them."""
    metric: str = "evaluation_greedy/return"
    """Column of the learning curve by which candidates are scored: its mean over the last 20% of the steps. A
    name without group is of `evaluation_greedy`."""
    lower_is_better: bool = False
    """Whether the metric is a cost."""

    def __post_init__(self) -> None:
        forms = "must name at least one algorithm, such as {ippo: [], mappo: []}"
        require_key(bool(self.algorithms), "algorithms", forms)
        require_at_least(1, candidates=self.candidates, env_steps=self.env_steps)
        require_value(self, "sampler_seed", 0 <= self.sampler_seed < 2**32, "must lie in [0, 2^32)")
        require_value(self, "seeds", 1 <= self.seeds <= 100, "must lie in [1, 100]")
        require_value(self, "keep", 0 < self.keep < 1, "must lie between 0 and 1")
        batch = self.batch
        require_key(
            batch is None or (batch >= 1 and self.candidates % batch == 0),
            "batch",
            f"of {batch} must divide candidates ({self.candidates}), or be null for one batch",
        )
        require_key(
            self.sampler != "tpe" or (batch is not None and batch < self.candidates),
            "batch",
            "must be set, below candidates, with sampler=tpe, which learns from one batch for the next",
        )
        ascending = all(a < b for a, b in zip((0, *self.rungs), (*self.rungs, self.env_steps), strict=True))
        require_key(ascending, "rungs", f"must ascend, between 0 and env_steps ({self.env_steps:,})")

    @property
    def training_seeds(self) -> tuple[int, ...]:
        """Training seeds of every candidate."""
        return tuple(range(FIRST_SEED, FIRST_SEED + self.seeds))

    @property
    def curve(self) -> str:
        """Column of the learning curve by which candidates are scored."""
        return self.metric if "/" in self.metric else f"evaluation_greedy/{self.metric}"

    def loss(self, score: float) -> float:
        """Return the score with the sign by which the best candidate has the least."""
        return score if self.lower_is_better else -score

    @property
    def ends(self) -> tuple[int, ...]:
        """Environment steps at each rung, and at the end."""
        return (*self.rungs, self.env_steps)

    def left_at(self, batch: int) -> list[int]:
        """Return how many candidates of a batch are trained up to each of `ends`."""
        left = [batch]
        for _ in self.rungs:
            left.append(ceil(self.keep * left[-1] - 1e-9))
        return left


@dataclass(frozen=True)
class AlgorithmSearch:
    """The search of one algorithm."""

    label: str
    """Its name in the search file."""
    space: Space
    overrides: tuple[str, ...]
    """Overrides of every candidate."""
    search: Search
    candidates: int
    """Number of candidates, smaller than the budget only if the grid is."""
    _composers: dict[tuple[str, ...], Callable[[Mapping[str, Any]], Experiment]] = field(default_factory=dict)
    """By the overrides of the named alternatives."""

    @property
    def batches(self) -> list[range]:
        """Numbers of the candidates of each batch."""
        size = self.search.batch or self.search.candidates
        return [range(first, min(first + size, self.candidates)) for first in range(0, self.candidates, size)]

    def experiment(self, number: int, values: Mapping[str, Value]) -> Experiment:
        """Return the experiment of a candidate. Raises HeadwayError if it is not valid."""
        words = (*self.overrides, *chosen_overrides(self.space, values))
        try:
            composed = self._composers.get(words) or composer(words)
            self._composers[words] = composed
            found = composed(candidate_settings(self.space, values))
        except HeadwayError as error:
            raise HeadwayError(f"{self.label}: {error}") from error
        name = ", ".join([f"candidate {number}", *names_of_choices(self.space, values)])
        return replace(found, config=replace(found.config, candidate=name))

    def steps(self) -> int:
        """Return the environment steps of all candidates and seeds together."""
        lengths = [end - begin for begin, end in zip((0, *self.search.ends), self.search.ends, strict=False)]
        return self.search.seeds * sum(
            count * length
            for batch in self.batches
            for count, length in zip(self.search.left_at(len(batch)), lengths, strict=True)
        )

    @property
    def first(self) -> Experiment:
        """Experiment with the first bound of each range and the first of each list of choices."""
        return self.experiment(0, corners(self.space)[0])

    @property
    def settings(self) -> dict[str, Any]:
        """All that decides which candidates are drawn, how they are trained and which are continued.

        The experiment is written out: a change of its file, or of a preset, is a change of the search.
        """
        ignored = ("algorithms", "candidates", "pieces", "base")
        batch = self.search.candidates if self.search.rungs and not self.search.batch else self.search.batch
        trained, stack = json.loads(identity(full_mapping(self.first, ())))
        return {
            **dict(flat(trained, with_empty=True)),
            "backend.stack": stack,
            **{key: value for key, value in plain(self.search).items() if key not in ignored},
            "batch": batch,
            "space": {key: plain(dimension) for key, dimension in self.space.items()},
        }


def read_search(name: str, overrides: Sequence[str] = ()) -> list[AlgorithmSearch]:
    """Return a search of the group `search`, one part per algorithm, checked as far as nothing is trained.

    `overrides` set keys of the search, or of all its runs. Raises HeadwayError if it does not exist or is not
    valid.
    """
    known = options()["search"]
    if name not in known:
        raise HeadwayError(f"there is no search {name!r}; {suggestion(name, known)}")
    own = {item.name for item in fields(Search)} - {"base", "algorithms", "space"}
    given = [word for word in overrides if word.partition("=")[0] in own]
    content = {**read_mapping(config_file("search", name)), **_values(given)}
    search = build(Search, content, f"search/{name}")
    others = [word for word in overrides if word not in given]
    parts = [_of_algorithm(name, search, label, others) for label in search.algorithms]
    require_one_session([part.first for part in parts])
    _require_column(parts)
    algorithms = {_algorithm(part.search, part.label) for part in parts}
    if useless := [piece for piece in search.pieces if algorithms.isdisjoint(read_piece(piece).algorithms)]:
        raise HeadwayError(
            f"search/{name}: no algorithm of this search has the piece {useless[0]}; leave it out"
        )
    return parts


def _values(overrides: Sequence[str]) -> dict[str, Any]:
    """Return the values of overrides of the search's own keys."""
    from omegaconf import OmegaConf
    from yaml import YAMLError

    try:
        values = OmegaConf.to_container(OmegaConf.from_dotlist(list(overrides)))
    except YAMLError as error:
        raise HeadwayError(
            f"{' '.join(overrides)} is not valid YAML: {' '.join(str(error).split())}"
        ) from error
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def _algorithm(search: Search, label: str) -> str:
    """Return the name of the algorithm with a label. Raises HeadwayError if there is none."""
    chosen = [word for word in search.algorithms[label] if word.startswith("algo=")]
    name = chosen[-1].removeprefix("algo=") if chosen else label
    if name not in algo_entries():
        raise HeadwayError(f"algorithms: no algorithm {name!r}; {suggestion(name, algo_entries())}")
    return name


def _of_algorithm(name: str, search: Search, label: str, given: Sequence[str]) -> AlgorithmSearch:
    algorithm = _algorithm(search, label)
    space: dict[str, Any] = {}
    for piece in search.pieces:
        found = read_piece(piece)
        if algorithm in found.algorithms:
            space |= dimensions(found.space, f"space/{piece}.space")
    space |= dimensions(search.space, f"search/{name}.space")
    if not space:
        raise HeadwayError(
            f"search/{name}: {label} has nothing to search: no dimension in space, and none of pieces "
            f"({', '.join(search.pieces) or 'none'}) is one of {algorithm}"
        )
    own = [word for word in search.algorithms[label] if not word.startswith("algo=")]
    chosen = (*search.base, f"algo={algorithm}", *own, *given)
    for word in chosen:
        key = word.lstrip("+~").partition("=")[0]
        if key in _REFUSED:
            raise HeadwayError(f"{word}: {_REFUSED[key]}")
    for word in given:
        if word.partition("=")[0] in space:
            raise HeadwayError(
                f"{word}: the search has this key in its space; leave it out, or change the file"
            )
    overrides = (f"study=search_{name}", f"evaluation.seed={EVALUATION_SEED}", *chosen)
    _require_unreported(search, label, overrides)
    fixed = (f"seed={','.join(map(str, search.training_seeds))}", f"env_steps={search.env_steps}")
    candidates = search.candidates
    if search.sampler == "grid":
        candidates = prod(map(len, grid(space).values()))
        if candidates > search.candidates:
            raise HeadwayError(
                f"search/{name}: the grid of {label} has {candidates:,} candidates, more than the budget of "
                f"{search.candidates:,}; raise candidates, or list fewer values"
            )
    part = AlgorithmSearch(label, space, (*overrides, *fixed, "evaluation.rules=[]"), search, candidates)
    for values in corners(space):
        _require_scores(search, part.experiment(0, values).config)
    return part


def _require_unreported(search: Search, label: str, overrides: Sequence[str]) -> None:
    """Raise HeadwayError if the experiment itself reports a seed on which candidates are trained."""
    try:
        reported = compose(overrides).config.seed
    except HeadwayError as error:
        raise HeadwayError(f"{label}: {error}") from error
    if shared := sorted(set(reported) & set(search.training_seeds)):
        raise HeadwayError(
            f"the experiment of this search reports seed {shared[0]}, on which candidates are trained (from "
            f"{FIRST_SEED} on): a winner looks better than it is on seeds that selected it; report others"
        )


def _require_column(parts: Sequence[AlgorithmSearch]) -> None:
    """Raise HeadwayError if evaluations have no such metric, as far as this is known before training."""
    search, known = parts[0].search, dict[str, PreparedEnv]()
    group, _, name = search.curve.partition("/")
    if not group.startswith("evaluation_") or name in _OF_ALL_EPISODES:
        return
    for part in parts:
        columns = [*_OF_ALL_EPISODES, *part.first.prepare(known).spec.metrics]
        if name not in columns:
            raise HeadwayError(f"metric={search.metric}: no such metric; {suggestion(name, columns)}")


def _require_scores(search: Search, config: ExperimentConfig) -> None:
    """Raise HeadwayError if candidates would have no score at a rung or at the end."""
    group = search.curve.partition("/")[0]
    modes = [f"evaluation_{mode}" for mode in config.evaluation.modes]
    if group.startswith("evaluation_") and group not in modes:
        raise HeadwayError(
            f"metric={search.metric} needs {group}, and evaluation.modes has "
            f"{', '.join(config.evaluation.modes)}"
        )
    if search.rungs and search.rungs[0] < config.evaluation.every:
        raise HeadwayError(
            f"rungs: after {search.rungs[0]:,} steps there is no evaluation yet; set evaluation.every, of "
            f"{config.evaluation.every:,} steps, to at most this"
        )
