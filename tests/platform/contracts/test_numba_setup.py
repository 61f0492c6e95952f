"""Cached machine code is kept exactly as long as all sources it was compiled from are unchanged."""

import subprocess
import sys
from pathlib import Path

import pytest

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


_DOUBLED = """
from headway.contracts.numba_setup import compiled_with

def double(x):
    return x + x

double = compiled_with(double)
"""
_COMPILED_TOGETHER = """
import sys, time
from numba.core.caching import IndexDataCacheFile
from doubled import double
load = IndexDataCacheFile._load_index
def load_slowly(self):
    index = load(self)
    time.sleep(1)  # both processes have the index by then, if it is not locked
    return index
IndexDataCacheFile._load_index = load_slowly
double(int(sys.argv[1]) if sys.argv[1].isdigit() else float(sys.argv[1]))
"""


@pytest.mark.slow
def test_two_processes_that_compile_one_function_keep_both_versions(tmp_path: Path) -> None:
    (tmp_path / "doubled.py").write_text(_DOUBLED)
    command = [sys.executable, "-c", _COMPILED_TOGETHER]
    processes = [subprocess.Popen([*command, number], cwd=tmp_path) for number in ("3", "0.5")]
    assert [process.wait(60) for process in processes] == [0, 0]
    used = "from doubled import double; print(double(3), double(0.5), sum(double.stats.cache_hits.values()))"
    shown = subprocess.check_output([sys.executable, "-c", used], cwd=tmp_path, text=True)
    assert shown.split() == ["6", "1.0", "2"]


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
