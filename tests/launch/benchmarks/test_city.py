import os
import subprocess
import sys

from headway_launch.benchmarks.city import tree_mb

HELD_MB = 60


def test_what_children_hold_counts() -> None:
    before = tree_mb(os.getpid())
    script = f"held = bytearray(b'x' * {HELD_MB * 2**20}); print('held', flush=True); input()"
    child = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdout is not None
    child.stdout.readline()
    during = tree_mb(os.getpid())
    child.communicate(b"\n")
    assert before > 10
    assert HELD_MB < during - before < HELD_MB + 40
    assert tree_mb(child.pid) == 0
