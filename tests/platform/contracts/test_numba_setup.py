"""Cached machine code is kept exactly as long as all sources it was compiled from are unchanged."""

import subprocess
import sys
from pathlib import Path

from headway.contracts.numba_setup import drop_stale_cache


def test_machine_code_is_removed_when_a_source_changes(tmp_path: Path) -> None:
    source, cache = tmp_path / "a.py", tmp_path / "__pycache__"
    source.write_text("SPEED = 1\n")
    cache.mkdir()
    kept, bytecode = cache / "a.nbi", cache / "a.pyc"
    for file in (kept, cache / "a.1.nbc", bytecode):
        file.write_bytes(b"machine code")
    drop_stale_cache(tmp_path)
    assert not kept.exists()  # its sources are unknown
    assert not list(cache.glob("*.nbc"))
    assert bytecode.exists()  # Python's bytecode

    kept.write_bytes(b"compiled anew")
    drop_stale_cache(tmp_path)
    assert kept.exists()

    source.write_text("SPEED = 2\n")
    drop_stale_cache(tmp_path)
    assert not kept.exists()

    kept.write_bytes(b"compiled anew")
    (tmp_path / "b.py").write_text("LENGTH = 5\n")
    drop_stale_cache(tmp_path)
    assert not kept.exists()


_SCIPY_AFTER = """
import sys
from headway_envs.intersection import kernel
kernel.warm()
assert not [name for name in sys.modules if name.partition(".")[0] == "scipy"]
import numba, numpy as np, scipy.linalg.cython_blas
squared = numba.njit(lambda a: a @ a)(2 * np.eye(3))
assert squared.trace() == 12, squared
"""


def test_kernels_do_not_load_scipy_but_others_can() -> None:
    subprocess.run([sys.executable, "-c", _SCIPY_AFTER], check=True, timeout=60)
