"""The candidates of a search: drawn by Optuna's samplers, and kept in a SQLite database beside the store."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from headway.contracts.checks import shown
from headway.contracts.errors import HeadwayError, one_line
from headway.store.atomic_files import make_folder
from headway_launch.experiments.search import AlgorithmSearch
from headway_launch.experiments.search_space import Choices, Dimension, Value, grid

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.samplers import BaseSampler

_SETTINGS = "headway"
"""User attribute of an Optuna study that holds `AlgorithmSearch.settings`."""


@dataclass(frozen=True)
class Trial:
    """A drawn candidate."""

    number: int
    values: Mapping[str, Value]
    scores: Mapping[int, float]
    """Environment steps -> score, at each rung and at the end, as far as it has ended."""
    state: str
    """RUNNING; COMPLETE, PRUNED or FAIL once its batch has ended."""

    @property
    def score(self) -> float | None:
        """Score after the most steps; None before the end of its batch, and if it failed."""
        return self.scores[max(self.scores)] if self.state in ("COMPLETE", "PRUNED") else None


class Trials:
    """The candidates of one algorithm.

    Each is drawn by a fresh sampler with a seed of its own, given those drawn before, and stored at once: it
    does not matter when a search was killed. Algorithms with equal spaces try equal random candidates.
    """

    def __init__(self, part: AlgorithmSearch, path: Path | None) -> None:
        """`path`: database, created if missing; None: in memory.

        Raises HeadwayError if Optuna is missing, and if the database cannot be read.
        """
        self._part, self._path, self._optuna = part, path, _optuna()
        self._study = self._open(path)

    def _open(self, path: Path | None) -> "Study":
        from sqlalchemy.exc import SQLAlchemyError

        optuna, part = self._optuna, self._part
        if path is not None:
            make_folder(path.parent)
        try:
            storage = None if path is None else optuna.storages.RDBStorage(f"sqlite:///{path}")
            study: Study = optuna.create_study(
                storage=storage,
                study_name=part.label,
                direction="minimize" if part.search.lower_is_better else "maximize",
                load_if_exists=True,
            )
            if _SETTINGS not in study.user_attrs:
                study.set_user_attr(_SETTINGS, _settings(part))
        except (SQLAlchemyError, RuntimeError, optuna.exceptions.OptunaError) as error:
            raise HeadwayError(
                f"{path} cannot be used as Optuna's database ({shown(one_line(error))}); move it"
            ) from error
        return study

    def require_settings(self) -> None:
        """Raise HeadwayError if the search has begun with other settings."""
        before, now = self._study.user_attrs[_SETTINGS], _settings(self._part)
        if before != now:
            changed = next(key for key in {**now, **before} if before.get(key) != now.get(key))
            raise HeadwayError(
                f"{self._part.label}: this search has begun with {changed}={shown(before.get(changed))}, not "
                f"{shown(now.get(changed))} ({self._path}); restore it, or give the search another study=NAME"
            )

    def all(self) -> list[Trial]:
        """Return all candidates drawn so far, in order."""
        return [
            Trial(trial.number, trial.params, trial.intermediate_values, trial.state.name)
            for trial in self._study.get_trials(deepcopy=False)
        ]

    def draw(self, count: int) -> list[Trial]:
        """Draw candidates until there are `count`, and return these."""
        optuna = self._optuna
        known = self._study.get_trials(deepcopy=False)
        if len(known) < count:
            drawn = optuna.create_study(direction=self._study.direction.name.lower())
            drawn.add_trials(known)
            for number in range(len(known), count):
                drawn.sampler = self._sampler(number)
                drawn.ask(self._distributions())
                asked = drawn.get_trials(deepcopy=False)[number]
                # Complete at once: a trial that is asked in the database itself gets one value after another.
                self._study.add_trial(
                    optuna.trial.create_trial(
                        state=optuna.trial.TrialState.RUNNING,
                        params=asked.params,
                        distributions=self._distributions(),
                        system_attrs=asked.system_attrs,
                    )
                )
        return self.all()[:count]

    def report(self, number: int, env_steps: int, score: float) -> None:
        """Store the score of a candidate after `env_steps` environment steps, unless it is there."""
        trial = self._study.get_trials(deepcopy=False)[number]
        if not trial.state.is_finished() and env_steps not in trial.intermediate_values:
            self._optuna.trial.Trial(self._study, trial._trial_id).report(score, env_steps)

    def end(self, number: int, state: str) -> None:
        """Store that a candidate is COMPLETE, PRUNED or FAIL, unless it has ended."""
        trial = self._study.get_trials(deepcopy=False)[number]
        if not trial.state.is_finished():
            value = trial.intermediate_values[max(trial.intermediate_values)] if state == "COMPLETE" else None
            self._study.tell(number, value, self._optuna.trial.TrialState[state])

    def _sampler(self, number: int) -> "BaseSampler":
        """Return the sampler that draws candidate `number`."""
        from headway.contracts.random_streams import child_seeds

        search, samplers = self._part.search, self._optuna.samplers
        if search.sampler == "grid":
            return samplers.GridSampler(grid(self._part.space), seed=search.sampler_seed)
        seed = int(child_seeds(search.sampler_seed, "search candidate", number, 1)[0] % 2**32)
        if search.sampler == "tpe":
            return samplers.TPESampler(n_startup_trials=search.batch or search.candidates, seed=seed)
        return samplers.RandomSampler(seed=seed)

    def _distributions(self) -> "dict[str, BaseDistribution]":
        return {key: self._distribution(dimension) for key, dimension in self._part.space.items()}

    def _distribution(self, dimension: Dimension) -> "BaseDistribution":
        distributions = self._optuna.distributions
        if isinstance(dimension, Choices):
            return distributions.CategoricalDistribution(tuple(dimension.choices))
        if dimension.whole:
            return distributions.IntDistribution(
                int(dimension.low), int(dimension.high), log=dimension.log, step=int(dimension.step or 1)
            )
        return distributions.FloatDistribution(
            dimension.low, dimension.high, log=dimension.log, step=dimension.step
        )


def _settings(part: AlgorithmSearch) -> dict[str, object]:
    """Return the settings as Optuna stores them."""
    settings: dict[str, object] = json.loads(json.dumps(part.settings, default=str))
    return settings


def _optuna() -> ModuleType:
    try:
        import optuna
    except ImportError as error:
        raise HeadwayError(
            'headway search needs Optuna, which is an extra: pip install "headway[search]"'
        ) from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    module: ModuleType = optuna
    return module
