"""Put `tests/support` and the root on the path, which worker processes inherit: tests share modules there.
Make once per test process what many tests begin with."""

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path

import pytest

import headway_envs.bus.scenario.synthetic as synthetic
from headway.store.tracking.client import Tracker
from headway_envs.bus.scenario.tables import Tables

TESTS = Path(__file__).parent
sys.path[:0] = [str(TESTS / "support"), str(TESTS.parent)]
os.environ["HEADWAY_TESTS"] = str(os.getpid())  # marks all processes that tests of this process start
os.environ["SPT_NOENV"] = "1"  # processes that Ray renames keep their environment readable


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files that wait for clusters first and quick ones last: with one file per worker process the long
    ones overlap, and none is left over for the end."""

    rank: dict[Path, int] = {}
    for item in items:
        marks = [item.get_closest_marker(name) is not None for name in ("cluster", "slow")]
        rank[item.path] = min(rank.get(item.path, 2), marks.index(True) if any(marks) else 2)
    items.sort(key=lambda item: rank[item.path])


@pytest.fixture(autouse=True, scope="session")
def _copied_databases(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Give new stores of this process a copy of an empty MLflow database."""
    create = Tracker._create_database
    empty = tmp_path_factory.mktemp("mlflow") / "empty.db"

    def copy(tracker: Tracker) -> None:
        path = tracker.root / "mlflow.db"
        if path.exists():
            return
        if not empty.exists():
            create(tracker)
            shutil.copy(path, empty)
        else:
            Path(shutil.copy(empty, path.with_suffix(".copy"))).replace(path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Tracker, "_create_database", copy)
        yield


@pytest.fixture(autouse=True, scope="session")
def _warm_workers() -> Iterator[None]:
    """Start worker processes warm."""
    from warm_workers import warm_workers

    with pytest.MonkeyPatch.context() as patch:
        warm_workers(patch)
        yield


@pytest.fixture(autouse=True, scope="session")
def _kept_scenarios() -> Iterator[None]:
    """Generate each bus scenario once: a district takes seconds."""
    generate = lru_cache(maxsize=8)(synthetic.generate)

    def generate_once(size: str, seed: int, after_line: Callable[[], None] = lambda: None) -> Tables:
        tables = generate(size, seed)
        for _ in range(synthetic.line_count(size)):
            after_line()
        return tables

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "generate", generate_once)
        yield
