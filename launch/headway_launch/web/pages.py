"""The pages of a store: the list of its studies, each study's report, and the MLflow UI."""

import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from statistics import mean
from threading import Lock
from typing import TYPE_CHECKING
from urllib.parse import quote

from werkzeug.wrappers import Request, Response

from headway.contracts.errors import HeadwayError
from headway.store.cell_names import cell_names
from headway.store.index import RunIndex, RunRow
from headway.store.query import newest_runs
from headway.store.run_folder import best_file, rules_file
from headway.store.tracking.sync import local_experiment
from headway.wording import counted
from headway_launch.console.number_formats import formatted
from headway_launch.web.mlflow_ui import PREFIX, ReadOnlyUI, runs_page

if TYPE_CHECKING:
    from _typeshed.wsgi import StartResponse, WSGIApplication, WSGIEnvironment

_REPORT = "/report/"


@dataclass(frozen=True)
class StudyEntry:
    """One line of the start page."""

    name: str
    runs: str
    """Numbers of its runs, by status."""
    best: str
    """Algorithm and mean final reward of the best cell, if all are on one environment."""
    environments: str
    started: str
    """Day and time of its newest run, UTC."""
    report: str
    """Path of its report; empty before the first run has finished."""
    runs_page: str
    """Path of its runs in MLflow; empty if MLflow's database lacks them."""


class Pages:
    """WSGI application with the pages of a store, for one store per process.

    `has_views` returns whether MLflow's experiments have the view of their runs.
    """

    def __init__(self, root: Path, has_views: Callable[[], bool]) -> None:
        self._root, self._has_views = root, has_views
        self._mlflow = ReadOnlyUI(root)
        self._reports: dict[str, tuple[object, str]] = {}
        """For each study its report's HTML, and the runs and rules that it was made from."""
        self._making = Lock()

    def __call__(self, environ: "WSGIEnvironment", start_response: "StartResponse") -> Iterable[bytes]:
        """Answer a request."""
        path = Request(environ).path
        application = self._mlflow if path.startswith(PREFIX) else self._page(path)
        return application(environ, start_response)

    def _page(self, path: str) -> "WSGIApplication":
        nonce, status = secrets.token_urlsafe(16), 200
        try:
            if path == "/":
                text = self._start(nonce, studies=study_entries(self._root, self._has_views()))
            elif path.startswith(_REPORT):
                text = self._report(path.removeprefix(_REPORT))
            else:
                raise HeadwayError(f"there is no page {path}")
        except HeadwayError as error:
            text, status = self._start(nonce, error=str(error)), 404
        policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'nonce-{nonce}'"
        headers = {"Content-Security-Policy": policy, "Referrer-Policy": "no-referrer"}
        return Response(text, status, headers, mimetype="text/html")

    def _start(self, nonce: str, studies: Sequence[StudyEntry] = (), error: str = "") -> str:
        from jinja2 import Environment

        source = files("headway_launch.web").joinpath("start.html").read_text(encoding="utf-8")
        page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(source)
        return page.render(store=str(self._root), studies=studies, error=error, nonce=nonce)

    def _report(self, study: str) -> str:
        from headway_launch.report.html_page import html
        from headway_launch.report.study_data import StudyData
        from headway_launch.report.study_report import report_of

        with self._making:
            rows = RunIndex(self._root).rows(study)
            cells = {row.cell for row in rows}
            files = [file(self._root, study, cell) for file in (rules_file, best_file) for cell in cells]
            rules = sorted(file.stat().st_mtime_ns for file in files if file.exists())
            made_from, text = self._reports.get(study, ((), ""))
            if not rows or (rows, rules) != made_from:
                text = html(report_of(StudyData(self._root, study), "headway browse"))
                self._reports[study] = (rows, rules), text
            return text


def study_entries(root: Path, has_views: bool = True) -> list[StudyEntry]:
    """Return the studies of a store, that with the newest run first."""
    rows = RunIndex(root).rows()
    newest = {row.study: place for place, row in enumerate(rows)}
    by_study = sorted(rows, key=lambda row: -newest[row.study])
    grouped = groupby(by_study, lambda row: row.study)
    return [_entry(study, list(runs), has_views) for study, runs in grouped]


def _entry(study: str, rows: Sequence[RunRow], has_views: bool) -> StudyEntry:
    counts = Counter(row.status.lower() for row in rows)
    environments = sorted({row.environment for row in rows})
    experiment = next((found for row in rows if (found := local_experiment(Path(row.directory)))), None)
    return StudyEntry(
        name=study,
        runs=", ".join(f"{count:,} {status}" for status, count in counts.most_common()),
        best=_best(rows),
        environments=environments[0] if len(environments) == 1 else counted(len(environments), "environment"),
        started=rows[-1].started[:16].replace("T", " "),
        report=f"{_REPORT}{quote(study, safe='')}" if counts["finished"] else "",
        runs_page=runs_page(experiment, has_views) if experiment else "",
    )


def _best(rows: Sequence[RunRow]) -> str:
    """Return mean final reward, algorithm and number of seeds of the best cell.

    Empty without a reward, and if the cells are on several environments or settings of one.
    """
    finished = [row for row in rows if row.status == "FINISHED" and row.final_reward is not None]
    rewards: dict[str, list[float]] = {}
    for row in newest_runs(finished):
        rewards.setdefault(row.cell, []).append(row.final_reward or 0.0)
    if len({name.task for name in cell_names(finished).values()}) != 1:
        return ""
    best = max(rewards, key=lambda cell: mean(rewards[cell]))
    algorithm = next(row.algorithm for row in rows if row.cell == best)
    return f"{formatted(mean(rewards[best]))} ({algorithm}, {counted(len(rewards[best]), 'seed')})"
