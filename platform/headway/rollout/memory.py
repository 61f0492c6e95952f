"""Memory that processes share and that vanishes with the last of them, however they end.

An anonymous file (memfd on Linux) is passed by descriptor: it has no name in /dev/shm that a killed
process could leave behind, and does not depend on the size of that mount.
"""

import mmap
import os
import tempfile
from multiprocessing import reduction
from typing import Any, Self

from headway.contracts import HeadwayError
from headway.rollout.usage import available_memory


class SharedBlock:
    """`nbytes` bytes shared by whoever holds the block; it can be given to a process as it starts."""

    def __init__(self, descriptor: int, nbytes: int) -> None:
        self._descriptor, self.nbytes = descriptor, nbytes
        self._map = mmap.mmap(descriptor, max(nbytes, 1))

    @classmethod
    def create(cls, nbytes: int) -> Self:
        """A new block of zeros. Raises HeadwayError where the memory cannot be had."""
        available = available_memory()
        if available is not None and nbytes > available:
            # An anonymous file has no limit of its own: the system would kill a process instead.
            raise _refusal(nbytes, f"{available / 2**20:.0f} MiB are free")
        try:
            descriptor = _anonymous_file()
        except OSError as error:
            raise _refusal(nbytes, error.strerror) from error
        try:
            os.posix_fallocate(descriptor, 0, max(nbytes, 1))
            return cls(descriptor, nbytes)
        except OSError as error:
            os.close(descriptor)
            raise _refusal(nbytes, error.strerror) from error

    @property
    def buffer(self) -> mmap.mmap:
        """The memory itself."""
        return self._map

    def __reduce__(self) -> tuple[Any, ...]:
        """Picklable only while a process is being started, which is given its own descriptor."""
        return _attach, (reduction.DupFd(self._descriptor), self.nbytes)

    def close(self) -> None:
        """Give up the descriptor; arrays over the memory stay valid. Closing again does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1


def _refusal(nbytes: int, reason: str | None) -> HeadwayError:
    return HeadwayError(
        f"no {nbytes / 2**20:.0f} MiB of shared memory for trajectories ({reason}); "
        "lower rollout.copies, rollout.steps or backend.parallel"
    )


def _attach(descriptor: Any, nbytes: int) -> SharedBlock:  # noqa: ANN401 - a private class of multiprocessing
    return SharedBlock(descriptor.detach(), nbytes)


def _anonymous_file() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("headway")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
