"""Put `tests/support` and the root on the path, which worker processes inherit: tests share modules there."""

import os
import sys
from pathlib import Path

import pytest

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
