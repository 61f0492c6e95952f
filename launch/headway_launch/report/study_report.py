"""The complete report of a study: its sections, and the summary at its top."""

import pandas as pd

from headway.stats.comparison import SEEDS_FOR_A_CLAIM
from headway.stats.samples import CONFIDENCE
from headway.store.provenance import provenance
from headway.wording import counted
from headway_launch.console.number_formats import formatted, scale_of, with_interval
from headway_launch.report.elements import Report, Section
from headway_launch.report.published import published_sections
from headway_launch.report.sections.absolute_metric import absolute_metric_section
from headway_launch.report.sections.costs import energy_section, tradeoff_section
from headway_launch.report.sections.learning import (
    across_environments,
    curves_section,
    episode_metrics_section,
)
from headway_launch.report.sections.provenance import provenance_section, runs_section
from headway_launch.report.sections.rewards import (
    final_reward_section,
    improvement_section,
    interquartile_section,
)
from headway_launch.report.sections.setting import setting_section
from headway_launch.report.sections.setup import setup_section
from headway_launch.report.study_data import StudyData

_MAX_PAIRS = 3
"""Maximum number of pairs of learners that the summary names."""


def report_of(data: StudyData, command: str) -> Report:
    """Return the report of a study, which `command` makes."""
    sections = [
        setup_section(data),
        final_reward_section(data),
        *published_sections(data),
        interquartile_section(data),
        absolute_metric_section(data),
        improvement_section(data),
        curves_section(data),
        setting_section(data),
        across_environments(data),
        episode_metrics_section(data),
        energy_section(data),
        tradeoff_section(data),
        runs_section(data),
        provenance_section(data),
        _definitions(),
    ]
    return Report(
        title=data.title,
        subtitle=f"{'; '.join(data.tasks)}: {counted(len(data.runs.rows), 'finished run')} of "
        f"{counted(len(data.controllers), 'learner')}, and "
        f"{counted(data.rules['rule'].nunique(), 'classical rule')}",
        summary=_summary(data),
        sections=[section for section in sections if section is not None],
        command=command,
        footer=f"Written by `{command}` from the store's files alone, with {_writer()}.",
    )


def _writer() -> str:
    """Describe the version and the machine that write the report."""
    tags = provenance()
    commit = ""
    if revision := tags.get("git.revision"):
        changed = ", with uncommitted changes" if tags.get("git.dirty") == "true" else ""
        commit = f" (commit {revision[:12]}{changed})"
    return f"headway {tags['version.headway']}{commit} on {tags['hardware.cpu']}, {tags['hardware.system']}"


def _summary(data: StudyData) -> list[str]:
    sentences = []
    for task in data.tasks:
        sentences += [_best_learner(data, task), *_learner_pairs(data, task), *_against_rules(data, task)]
    fewest = min(len(members) for members in data.cells.values())
    if fewest < SEEDS_FOR_A_CLAIM:
        sentences.append(
            f"The smallest cell has {counted(fewest, 'seed')}, too few to claim which controller is "
            f"better: a claim needs at least {SEEDS_FOR_A_CLAIM}."
        )
    sentences.append(_cost(data))
    if data.excluded:
        sentences.append(f"Excluded runs: {'; '.join(data.excluded)}.")
    return sentences


def _best_learner(data: StudyData, task: str) -> str:
    last = {name: data.by_seed(task, name, data.column) for name in data.on(task)}
    has_last = all(episodes.size for episodes in last.values())
    if has_last:
        means = pd.Series({name: episodes.mean(axis="columns").mean() for name, episodes in last.items()})
        what = f"mean {data.readable(data.column).partition(', ')[0]} in the last evaluation"
        episodes = data.last_episodes(task)
    else:
        means = data.scores_on(task).groupby("controller")["final_reward"].mean()
        what, episodes = f"mean final {data.metric_label}", f"{data.curve_episodes(task)} per evaluation"
    best = (means * data.sign).max()
    names = [str(name) for name in means.index if means[name] * data.sign == best]
    seeds = counted(min(len(data.on(task)[name]) for name in names), "seed")
    where = f"On {task}, among" if len(data.tasks) > 1 else "Among"
    kind = "lowest" if data.lower_is_better else "highest"
    value = f"{formatted(best * data.sign)} over {seeds}"
    if len(means) == 1:
        line = f"`{names[0]}` has a {what} of {value} on {task} ({episodes})."
    else:
        line = (
            f"{where} the learners, {' and '.join(f'`{name}`' for name in names)} "
            f"{'has' if len(names) == 1 else 'have'} the {kind} {what}: {value} ({episodes})."
        )
    if not has_last:
        return line
    return (
        f"{line} The final {data.metric_label} below is another value: the mean over the last 20% of the "
        f"curve, with {data.curve_episodes(task)} per evaluation, the first of these."
    )


def _learner_pairs(data: StudyData, task: str) -> list[str]:
    """Say which pairs of learners differ; nothing if the pairs were not compared."""
    pairs = data.learner_pairs.get(task, [])
    differ = [
        (pair.a, pair.b) if data.sign * pair.difference.estimate > 0 else (pair.b, pair.a)
        for pair in pairs
        if pair.corrected_p < 1 - CONFIDENCE and min(pair.difference.seeds) >= SEEDS_FOR_A_CLAIM
    ]
    if not pairs:
        return []
    number = f"{len(differ)} of {counted(len(pairs), 'pair')}" if differ else "no pair"
    which = ", ".join(f"`{better}` is better than `{worse}`" for better, worse in differ[:_MAX_PAIRS])
    more = "; ..." if len(differ) > _MAX_PAIRS else ""
    verb = "differ" if len(differ) > 1 else "differs" if differ else "is shown to differ"
    return [
        f"Of the learners{data.where(task)}, {number} {verb} in the last evaluation, with p corrected by "
        f"Holm below 5% and at least {SEEDS_FOR_A_CLAIM} seeds of both{': ' if differ else ''}{which}{more}."
    ]


def _against_rules(data: StudyData, task: str) -> list[str]:
    if task not in data.best_rules:
        return [
            f"The store has no episodes of rules on {task}, so it is unknown whether learning beats a simple "
            "rule. A sweep evaluates the rules once all of its runs have ended; `headway compare` evaluates "
            "them at any time, but stores nothing."
        ]
    rule = data.best_rules[task]
    better, worse = (
        ("better, below it", "worse, above it") if data.lower_is_better else ("above it", "below it")
    )
    no_claims = {kind: f"no claim ({kind})" for kind in (better, worse)}
    kinds = (better, worse, *no_claims.values(), "no difference shown")
    groups: dict[str, list[str]] = {kind: [] for kind in kinds}
    unknown: dict[str, str] = {}
    for controller, members in data.on(task).items():
        against = data.against_best_rule(task, controller)
        if (found := against.interval) is None:
            unknown[controller] = against.reason
            continue
        kind = better if data.sign * found.estimate > 0 else worse
        if len(members) < SEEDS_FOR_A_CLAIM:
            kind = no_claims[kind]
        shown = f"`{controller}` ({with_interval(found.estimate, found.low, found.high, sign='+')})"
        groups[kind if found.excludes_zero else "no difference shown"].append(shown)
    known = [f"{kind}: {', '.join(names)}" for kind, names in groups.items() if names]
    if not known:
        why = "; ".join(dict.fromkeys(unknown.values()))
        return [f"The best rule on {task} is `{rule}`; the learners' difference from it is unknown: {why}."]
    if unknown:
        known.append("unknown: " + ", ".join(f"`{name}` ({reason})" for name, reason in unknown.items()))
    episodes = data.last_episodes(task)
    return [
        f"Compared with the best rule on {task}, `{rule}`, in the last evaluation ({episodes}) [95% "
        f"intervals]: {'; '.join(known)}."
    ]


def _cost(data: StudyData) -> str:
    used = data.summaries
    measured = used[used["kwh"].notna()]
    if measured.empty:
        cpu = formatted(used["cpu_seconds"].sum())
        return f"The finished runs used {cpu} CPU seconds; their energy was not measured."
    kwh = float(measured["kwh"].sum())
    kwh_unit, kwh_factor = scale_of(kwh, "kWh")
    runs = "The finished runs"
    if len(measured) < len(used):
        runs = f"The {len(measured)} of {counted(len(used), 'finished run')} with measured energy"
    total = (
        f"{formatted(kwh * kwh_factor)} {kwh_unit} ({formatted(measured['cpu_seconds'].sum())} CPU seconds)"
    )
    if measured["kg_co2"].isna().any():
        return f"{runs} used {total}."
    co2 = float(measured["kg_co2"].sum())
    co2_unit, co2_factor = scale_of(co2, "kg")
    emitted = f"{formatted(co2 * co2_factor)} {co2_unit} of CO2eq"
    return f"{runs} used {total}, equivalent to {emitted}."


def _definitions() -> Section:
    return Section(
        "definitions",
        "Definitions",
        [
            "Final reward: mean over the last 20% of the curve's steps. AUC: area under the "
            "min-max-normalised curve by the trapezoidal rule, divided by its span of steps.",
            "Interquartile mean, stratified bootstrap, probability of improvement, performance profile: "
            "Agarwal et al. 2021, Deep RL at the Edge of the Statistical Precipice, arXiv:2108.13264.",
            "Intervals of differences: Student's t over episodes for one seed or a rule; for several "
            "seeds, over seeds and episodes: the squared half widths over seeds and over episodes are "
            "added (Banerjee 1961, Sankhya A 23). Between learners, whose seeds are independent: over the "
            "seeds of each and over episodes, added likewise; p is the smallest value at which such an "
            "interval excludes 0, corrected for the number of pairs by Holm 1979, Scandinavian Journal of "
            "Statistics 6. Seeds needed: the power of that interval, as Colas et al. 2018, arXiv:1806.08295, "
            "compute it for Welch's t.",
            "Average ranks over environments: Demsar 2006, JMLR 7, with Friedman's test by permutation and "
            "exact Wilcoxon signed-rank tests of the pairs (Benavoli et al. 2016, JMLR 17). Absolute metric: "
            "Gorsane et al. 2022, arXiv:2209.10485.",
            "Energy and CO2: CodeCarbon, codecarbon.io; the machine's energy is divided among the runs by "
            "their CPU seconds, memory and share of the GPU.",
        ],
    )
