"""Importing the registry of environments imports no heavy package."""

import subprocess
import sys


def test_importing_the_registry_imports_nothing_heavy() -> None:
    heavy = ("numba", "pandas", "pettingzoo", "gymnasium", "torch", "supersuit", "mlflow")
    program = (
        "import sys, headway_envs.registry as e; assert e.ENTRIES; "
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
