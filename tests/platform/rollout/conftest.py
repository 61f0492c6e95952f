"""Worker processes must find the environments of these tests: they inherit the module search path."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
