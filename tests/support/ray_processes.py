"""Ray's processes on this machine, so that tests can check that none of theirs is left."""

import os
import re

import psutil

_RAYS = re.compile(r"ray::|/ray/(core|_private|dashboard|autoscaler)/")


def ray_processes() -> set[psutil.Process]:
    """Return the daemons and workers of all clusters that tests of this process have started."""
    found = set()
    for process in psutil.process_iter():
        try:
            if process.status() == psutil.STATUS_ZOMBIE or not _RAYS.search(" ".join(process.cmdline())):
                continue
            if process.environ().get("HEADWAY_TESTS") == os.environ["HEADWAY_TESTS"]:
                found.add(process)
        except psutil.Error:
            continue
    return found


def assert_gone(before: set[psutil.Process], timeout_s: float = 120.0) -> None:
    """Assert that all processes started since `before` end; a killed cluster needs up to a minute."""
    _, alive = psutil.wait_procs(ray_processes() - before, timeout=timeout_s)
    assert not alive
