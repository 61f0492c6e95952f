"""Runs of a moment, and their records as a session that was killed leaves them."""

import json
from pathlib import Path

from headway.store.index import RunIndex, RunRow

SMALL = (
    "energy=off", "rollout.copies=4", "rollout.block=2", "rollout.steps=16", "env_steps=64",
    "evaluation.episodes=1", "evaluation.final_episodes=2",
)  # fmt: skip
"""One iteration and its evaluations; overrides after these take precedence."""


def end_as(directory: str | Path, status: str = "KILLED", **changes: object) -> None:
    """Change the status of a stored run, as if its session had ended otherwise, and other keys."""
    path = Path(directory, "run.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"status": status, **changes}))


def stored_rows(folder: Path | None = None) -> list[RunRow]:
    """Return the runs stored in `runs` of a folder, the working directory by default, as they began."""
    return sorted(RunIndex((folder or Path()) / "runs").rows(), key=lambda row: row.started)
