"""The section on what was trained and how it was evaluated."""

from typing import Any

import pandas as pd

from headway.wording import spans
from headway_launch.console.number_formats import MISSING
from headway_launch.report.elements import Part, Section, table_by_task
from headway_launch.report.study_data import StudyData


def setup_section(data: StudyData) -> Section:
    """Return the section with each learner's policies, preset, seeds and steps, and the evaluations."""
    rows: list[list[str]] = []
    exact: list[dict[str, Any]] = []
    for (task, controller), members in data.cells.items():
        seeds, steps = sorted({row.seed for row in members}), data.budgets(task)[controller]
        rows.append(
            [
                task,
                controller,
                members[0].policies or MISSING,
                members[0].preset or MISSING,
                spans(seeds),
                " or ".join(f"{number:,}" for number in steps),
            ]
        )
        exact += [
            {
                "environment": task,
                "controller": controller,
                "policies": row.policies,
                "preset": row.preset,
                "seed": row.seed,
                "env_steps": row.env_steps,
            }
            for row in members
        ]
    caption = "What was trained; the command lines are under Provenance."
    headings = ["controller", "policies", "preset", "seeds", "environment steps per seed"]
    table = table_by_task(data.tasks, "setup", caption, headings, rows, pd.DataFrame(exact), words=(2, 3, 4))
    body: list[Part] = [table, *(_evaluation(data, task) for task in data.tasks)]
    return Section("setup", "Setup", body)


def _evaluation(data: StudyData, task: str) -> str:
    """Describe the evaluations on a task and its rules."""
    rules = data.ranked_rules(task)
    named = f"; on these also the rules {', '.join(f'`{rule}`' for rule in rules)}" if rules else ""
    return (
        f"Policies on {task} act {'greedily' if data.mode == 'greedy' else 'by sampling'} in evaluations on "
        f"held-out episodes: {data.curve_episodes(task)} per point of the curves, "
        f"{data.last_episodes(task)} in the last evaluation{named}."
    )
