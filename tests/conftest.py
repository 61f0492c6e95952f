"""Put `tests/support` and the root on the path, which worker processes inherit: tests share modules there."""

import sys
from pathlib import Path

TESTS = Path(__file__).parent
sys.path[:0] = [str(TESTS / "support"), str(TESTS.parent)]
