"""Modules that several tests share lie in `tests/support`: worker processes inherit the path to them."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "support"))
