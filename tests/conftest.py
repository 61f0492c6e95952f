"""Put `tests/support` and the root on the path, which worker processes inherit: tests share modules there."""

import os
import sys
from pathlib import Path

TESTS = Path(__file__).parent
sys.path[:0] = [str(TESTS / "support"), str(TESTS.parent)]
os.environ["HEADWAY_TESTS"] = str(os.getpid())  # marks all processes that tests of this process start
os.environ["SPT_NOENV"] = "1"  # processes that Ray renames keep their environment readable
