"""What of Ray runs on this machine, so that tests can see that nothing of theirs stays."""

import os
import re

import psutil

_RAYS = re.compile(r"ray::|/ray/(core|_private|dashboard|autoscaler)/")


def ray_processes() -> set[psutil.Process]:
    """Daemons and workers of all clusters that tests of this process have started."""
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
    """That all that were not there before end; agents of a cluster that was killed take up to a minute."""
    _, alive = psutil.wait_procs(ray_processes() - before, timeout=timeout_s)
    assert not alive
