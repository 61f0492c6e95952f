"""Questions to processes that may end at any time."""

import psutil


def words_of(process: psutil.Process) -> str:
    """Return the command line of a process; empty if it has ended."""
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


def children_of(process: psutil.Process, recursive: bool = False) -> list[psutil.Process]:
    """Return the children of a process, or all its descendants; none if it has ended."""
    try:
        return list(process.children(recursive=recursive))
    except psutil.NoSuchProcess:
        return []


def workers_of(trainer: psutil.Process) -> list[psutil.Process]:
    """Return the rollout workers of a training process, which are children of its fork server."""
    return [worker for server in children_of(trainer) for worker in children_of(server)]
