"""`run` and `sweep` for scripts and notebooks."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError

if TYPE_CHECKING:
    from headway.store.query import RunSelection
    from headway_launch.runner.runner import Runner


def run(*overrides: str, config_dir: str | Path | None = None, **keys: object) -> "RunSelection":
    """Train as `headway run` does, and return the runs.

        runs = run("experiment=bus_mappo", "algo.lr=3e-4", seed=range(4))
        runs.runs()                              # a pandas frame; also runs.curves([...]), runs.energy() ...

    `overrides`: the words of the command line, among them the path of an experiment's file. `keys`: further
    keys with Python values; those with a dot as `**{"algo.lr": 3e-4}`. `config_dir`: as `--config-dir`.

    Progress and the table of results are shown as on the command line. A run that fails does not stop the
    others; its `status` is FAILED. Ctrl-C stops with a checkpoint and raises KeyboardInterrupt; `headway
    resume` continues the runs. Raises HeadwayError where the command would print an error. Works in the main
    thread only, and in scripts without `if __name__ == "__main__"`.
    """
    from headway_launch.experiments.compose import compose
    from headway_launch.experiments.override_words import override_words
    from headway_launch.runner.jobs import CellPlan, plan_jobs
    from headway_launch.runner.runner import Runner

    with _session(config_dir):
        experiment = compose([*overrides, *override_words(keys)])
        runner = Runner([CellPlan(experiment, plan_jobs(experiment))])
        return _selection(runner, runner.run())


def sweep(
    *overrides: str,
    fresh: bool = False,
    config_dir: str | Path | None = None,
    **keys: object,
) -> "RunSelection":
    """Train every combination that is not in the store, as `headway sweep` does, and return all its runs.

        runs = sweep("experiment=bus_mappo", algo=["ippo", "mappo"], seed=range(10))

    Each value of a list in `keys` makes a cell, like `choice(...)` in a word. Runs that had finished before
    are returned too. `fresh`: as `--fresh`. The rest is as for `run`.
    """
    from headway_launch.experiments.override_words import override_words
    from headway_launch.experiments.sweep import compose_sweep
    from headway_launch.studies.plan import distinct
    from headway_launch.studies.session import StudySession

    with _session(config_dir):
        experiments = distinct(compose_sweep([*overrides, *override_words(keys, sweep=True)]))
        return _selection(*StudySession.plan(experiments, fresh=fresh).train())


@contextmanager
def _session(config_dir: str | Path | None) -> Iterator[None]:
    from headway_launch.console.output import distinct_notices, exit_of_environment
    from headway_launch.console.threads import one_thread
    from headway_launch.experiments.options import own_configs

    if threading.current_thread() is not threading.main_thread():
        raise HeadwayError("run and sweep work in the main thread only, where Ctrl-C reaches them")
    try:
        own = nullcontext() if config_dir is None else own_configs(str(config_dir))
        with one_thread(), distinct_notices(), own:
            yield
    except SystemExit as error:
        raise HeadwayError(exit_of_environment(error)) from error


def _selection(runner: "Runner", code: int) -> "RunSelection":
    """Return the runs of a session. Raises KeyboardInterrupt if it was stopped."""
    from headway_launch.runner.runner import EXIT_STOPPED

    if code == EXIT_STOPPED:
        raise KeyboardInterrupt
    return runner.selection()
