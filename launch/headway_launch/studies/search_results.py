"""Results of a search: the best candidates, what they cost, the expected best of n, and a preset."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.config.experiment import NO_PRESET
from headway.stats.best_of import BestOf, expected_best
from headway.store.atomic_files import make_folder, write_text
from headway_launch.console.number_formats import with_deviation
from headway_launch.console.tables import Value, print_table, without_empty
from headway_launch.experiments.compose import compose
from headway_launch.experiments.options import own_configs
from headway_launch.experiments.override_words import written
from headway_launch.experiments.parameters import flat, full_mapping
from headway_launch.experiments.search import AlgorithmSearch
from headway_launch.experiments.search_space import candidate_overrides, is_searched
from headway_launch.studies.search_session import Candidate, SearchSession

if TYPE_CHECKING:
    from headway.store.index import RunRow

_LISTED = 3
"""Candidates of each algorithm in the table."""
_TASK = ("experiment=", "env=", "env.args.", "stages=")
"""Beginnings of the overrides that a preset leaves to the command."""


@dataclass(frozen=True)
class AlgorithmResult:
    """The candidates of one algorithm, best first, and their runs."""

    part: AlgorithmSearch
    ranked: Sequence[Candidate]
    """Candidates: those trained to the end by score, best first; then the others by steps, most first."""
    unscored: int
    """Number of candidates that failed."""
    runs: Mapping[str, Sequence["RunRow"]]
    """Runs by `Candidate.identity`."""

    @property
    def best(self) -> Candidate | None:
        """The best of the candidates that were trained to the end; None if there is none."""
        return next((each for each in self.ranked if each.trial.state == "COMPLETE"), None)

    def steps_of(self, candidate: Candidate) -> int:
        """Return the environment steps that a candidate was trained, over its seeds."""
        return sum(row.env_steps for row in self.runs.get(candidate.identity, ()))

    def total(self, column: str) -> float | None:
        """Return the sum of a column of `RunRow` over all runs; None if none is known."""
        runs = {row.run_id: row for rows in self.runs.values() for row in rows}
        known = [value for row in runs.values() if (value := getattr(row, column)) is not None]
        return sum(known) if known else None

    @property
    def expected_best(self) -> BestOf | None:
        """Expected best of n of the candidates; one that failed counts as the worst. None without scores."""
        scores = [each.trial.score for each in self.ranked if each.trial.score is not None]
        if not scores:
            return None
        lower = self.part.search.lower_is_better
        return expected_best([*scores, *[(max if lower else min)(scores)] * self.unscored], lower)


def results_of(session: SearchSession) -> list[AlgorithmResult]:
    """Return the results of all algorithms, as far as their candidates have ended."""
    results = []
    for part in session.parts:
        candidates = session.candidates(part)
        scored = [each for each in candidates if each.trial.score is not None]
        failed = sum(each.trial.state == "FAIL" for each in candidates)
        results.append(AlgorithmResult(part, sorted(scored, key=_rank), failed, session.runs_of(candidates)))
    return results


def _rank(candidate: Candidate) -> tuple[int, float]:
    """Return the key by which the best candidate is the first: trained longest, then scored best."""
    assert candidate.trial.score is not None
    return -max(candidate.trial.scores), candidate.part.search.loss(candidate.trial.score)


def print_results(results: Sequence[AlgorithmResult]) -> None:
    """Print the best candidates, the cost of each algorithm and the expected best of n."""
    search = results[0].part.search
    rows: list[tuple[Value, ...]] = []
    for result in results:
        for candidate in result.ranked[:_LISTED]:
            words = candidate_overrides(result.part.space, candidate.trial.values)
            name = candidate.experiment.config.candidate.removeprefix("candidate ")
            score, steps = candidate.trial.score, result.steps_of(candidate)
            rows.append((result.part.label, name, score, steps, " ".join(map(_rounded, words))))
    print_table(("algorithm", "candidate", "score", "steps", "settings"), rows, f"best by {search.curve}")
    print()
    costs: list[tuple[Value, ...]] = [
        (
            result.part.label,
            f"{len(result.ranked) + result.unscored} of {result.part.candidates}",
            sum(each.trial.state == "COMPLETE" for each in result.ranked),
            result.unscored,
            int(result.total("env_steps") or 0),
            result.total("cpu_seconds"),
            result.total("kwh"),
        )
        for result in results
    ]
    columns = ("algorithm", "candidates", "to the end", "failed", "steps", "CPU s", "kWh")
    print_table(*without_empty(columns, costs, ("kWh",)), "spent")
    curves = {result.part.label: best for result in results if (best := result.expected_best) is not None}
    if curves:
        print()
        print_table(
            ("candidates n", *curves), _best_of_rows(curves), "expected best of n, and its standard deviation"
        )
        for line in order_lines(curves, search.lower_is_better):
            print(line)


def _rounded(word: str) -> str:
    """Return an override with four digits if it sets a fraction."""
    key, _, value = word.partition("=")
    try:
        return word if value.lstrip("-").isdigit() else f"{key}={float(value):.4g}"
    except ValueError:
        return word


def _best_of_rows(curves: Mapping[str, BestOf]) -> list[tuple[Value, ...]]:
    most = max(len(best.mean) for best in curves.values())
    shown = sorted({*(2**power for power in range(most.bit_length())), most})
    return [
        (
            n,
            *(
                with_deviation(best.mean[n - 1], best.std[n - 1]) if n <= len(best.mean) else None
                for best in curves.values()
            ),
        )
        for n in shown
    ]


def order_lines(curves: Mapping[str, BestOf], lower_is_better: bool) -> list[str]:
    """Return the order of algorithms by expected best of n, one line per span of n in which it stays."""
    if len(curves) < 2:
        return []
    fewest = min(len(best.mean) for best in curves.values())
    orders = [
        _order({label: float(best.mean[n]) for label, best in curves.items()}, lower_is_better)
        for n in range(fewest)
    ]
    lines = []
    for order, members in groupby(range(fewest), key=orders.__getitem__):
        first, *others = members
        lines.append(f"n = {first + 1}{f' to {others[-1] + 1}' if others else ''}: {order}")
    return lines


def _order(scores: Mapping[str, float], lower_is_better: bool) -> str:
    """Return the labels in the order of their scores, best first, equal ones joined by `=`."""
    sign = 1 if lower_is_better else -1
    first, *others = sorted(scores, key=lambda label: sign * scores[label])
    text = first
    for label in others:
        text += f" = {label}" if scores[label] == scores[first] else f", then {label}"
        first = label
    return text


def write_picture(results: Sequence[AlgorithmResult], path: Path) -> bool:
    """Draw the expected best of n; return False if no candidate has a score."""
    from headway.stats import plots
    from headway_launch.console.output_files import write_figure

    curves = {result.part.label: best for result in results if (best := result.expected_best) is not None}
    if not curves:
        return False
    label = f"expected best {results[0].part.search.curve}"
    title = f"{path.stem}: best of n candidates, with standard deviation"
    write_figure(plots.best_of_n(curves, label, plots.colours(list(curves)), title), path)
    return True


def presets_of(results: Sequence[AlgorithmResult], stem: str) -> dict[str, dict[str, AlgorithmResult]]:
    """Return the results of which the presets of a search consist: preset -> algorithm -> result.

    The preset `stem` has the better label of each algorithm; labels that share an algorithm have one preset
    each too. Empty if no candidate was trained to the end.
    """
    labels: dict[str, list[AlgorithmResult]] = {}
    for result in results:
        if result.best is not None:
            labels.setdefault(result.best.experiment.algo_name, []).append(result)
    best = {name: min(own, key=lambda each: _rank(each.ranked[0])) for name, own in labels.items()}
    shared = {
        f"{stem}_{re.sub(r'[^A-Za-z0-9_.]', '-', result.part.label)}": {name: result}
        for name, own in labels.items()
        for result in own
        if len(own) > 1
    }
    return {stem: best, **shared} if best else {}


def write_preset(winners: Mapping[str, AlgorithmResult], path: Path, search: str) -> list[str]:
    """Write a preset with the best candidate of each of `winners`, results by algorithm.

    Returns lines on settings that experiments set over any preset.
    """
    import yaml

    values: dict[str, Any] = {name: _tuned(result) for name, result in winners.items()}
    bases = [result.ranked[0].experiment.config.preset for result in winners.values()]
    if base := next((each for each in bases if each not in ("", NO_PRESET)), None):
        values = {"defaults": [base, "_self_"], **values}
    parts = [result.part for result in winners.values()]
    comment = (
        f"# Found by `headway search {search}` for {', '.join(part.label for part in parts)}: the best of "
        f"{parts[0].search.candidates} candidates each, of {parts[0].search.env_steps:,} steps.\n"
    )
    make_folder(path.parent)
    write_text(path, comment + yaml.safe_dump(values, sort_keys=False))
    return [line for name, result in winners.items() for line in _overridden(name, result, path)]


def _tuned(result: AlgorithmResult) -> dict[str, Any]:
    """Return what a preset sets for the best candidate, as nested mappings."""
    best = result.ranked[0]
    words = (*result.part.overrides, *candidate_overrides(result.part.space, best.trial.values))
    mapping = full_mapping(best.experiment, ())
    nested: dict[str, Any] = {}
    for word in words:
        key = word.lstrip("+").partition("=")[0]
        if is_searched(key) and key != "algo":
            *path, last = key.split(".")
            inner, value = nested, mapping
            for part in path:
                inner, value = inner.setdefault(part, {}), value[part]
            inner[last] = value[last]
    return nested


def task_words(part: AlgorithmSearch) -> list[str]:
    """Return the overrides that choose the task of a search: its experiment or environment."""
    return [word for word in part.overrides if word.startswith(_TASK)]


def _overridden(name: str, result: AlgorithmResult, path: Path) -> list[str]:
    """Return lines on keys of the best candidate that its task sets itself, over any preset."""
    with own_configs(str(path.parent.parent)):
        given = compose([*task_words(result.part), f"algo={name}", f"preset={path.stem}"])
    theirs, ours = (
        dict(flat(full_mapping(each, ()), with_empty=True)) for each in (given, result.ranked[0].experiment)
    )
    return [
        f"{result.part.label}: the experiment sets {key} over any preset; add {key}={written(value)}"
        for key, value in ours.items()
        if is_searched(key) and theirs.get(key) != value
    ]
