"""Memory that processes share and that vanishes with the last of them, however they end; and memory that a
process has freed, given back to the system.

What is shared is an anonymous file (memfd on Linux), passed by descriptor: it has no name in /dev/shm that a
killed process could leave behind, and does not depend on the size of that mount.
"""

import ctypes
import mmap
import os
import pickle
import tempfile
from dataclasses import dataclass
from itertools import accumulate
from multiprocessing import reduction
from typing import Any, Generic, Literal, Self, TypeVar

from headway.contracts import HeadwayError
from headway.contracts.trajectory import aligned
from headway.rollout.workers.usage import available_memory

ValueT = TypeVar("ValueT")

Content = Literal["trajectories", "parameters", "the environment"]
_LOWER: dict[Content, str] = {
    "trajectories": "rollout.copies, rollout.steps or backend.parallel",
    "parameters": "the size of the networks or backend.parallel",
    "the environment": "its size (env.args) or backend.parallel",
}
"""What makes a block smaller, or leaves more room for it, by what is in it."""


class SharedBlock:
    """`nbytes` bytes shared by whoever holds the block; it can be given to a process as it starts."""

    def __init__(self, descriptor: int, nbytes: int) -> None:
        self._descriptor, self.nbytes = descriptor, nbytes
        self._map = mmap.mmap(descriptor, max(nbytes, 1))

    @classmethod
    def create(cls, nbytes: int, content: Content = "trajectories") -> Self:
        """A new block of zeros, for such `content`. Raises HeadwayError where the memory cannot be had."""
        available = available_memory()
        if available is not None and nbytes > available:
            # An anonymous file has no limit of its own: the system would kill a process instead.
            raise _refusal(nbytes, content, f"{available / 2**20:.0f} MiB are free")
        try:
            descriptor = _anonymous_file()
        except OSError as error:
            raise _refusal(nbytes, content, error.strerror) from error
        try:
            os.posix_fallocate(descriptor, 0, max(nbytes, 1))
            return cls(descriptor, nbytes)
        except OSError as error:
            os.close(descriptor)
            raise _refusal(nbytes, content, error.strerror) from error

    @property
    def buffer(self) -> mmap.mmap:
        """The memory itself."""
        return self._map

    def private(self) -> mmap.mmap:
        """The memory, of which pages become one's own as they are written to here, unseen by others. Pages
        not yet written to follow the block, to which nobody may write any more."""
        return mmap.mmap(self._descriptor, max(self.nbytes, 1), access=mmap.ACCESS_COPY)

    def __reduce__(self) -> tuple[Any, ...]:
        """Picklable only while a process is being started, which is given its own descriptor."""
        return _attach, (reduction.DupFd(self._descriptor), self.nbytes)

    def close(self) -> None:
        """Give up the descriptor; arrays over the memory stay valid. Closing again does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1


@dataclass(frozen=True)
class SharedPickle(Generic[ValueT]):
    """An object pickled into a block. The arrays of all who load it lie in that one block, which each may
    write to as if it were its own: what an environment prepares may be large, and its workers many."""

    block: SharedBlock
    parts: tuple[slice, ...]
    """Where the pickle lies in it, and then its arrays."""
    mentions_main: bool
    """It refers to something of the main module."""

    @classmethod
    def of(cls, value: ValueT) -> Self:
        """Raises what pickling does, and HeadwayError where the memory cannot be had."""
        buffers: list[pickle.PickleBuffer] = []
        pickled = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        contents = [memoryview(pickled), *(buffer.raw() for buffer in buffers)]
        ends = list(accumulate(aligned(content.nbytes) for content in contents))
        parts = tuple(
            slice(begin, begin + content.nbytes)
            for begin, content in zip([0, *ends[:-1]], contents, strict=True)
        )
        block = SharedBlock.create(ends[-1], "the environment")
        for part, content in zip(parts, contents, strict=True):
            block.buffer[part] = content
        return cls(block, parts, b"_main__" in pickled)

    def load(self) -> ValueT:
        """The object, as often as wanted: each has its arrays to itself."""
        memory = memoryview(self.block.private())
        pickled, *arrays = (memory[part] for part in self.parts)
        value: ValueT = pickle.loads(pickled, buffers=arrays)
        return value


def give_back_memory() -> None:
    """Return to the system what this process has freed. Linux's C library keeps what lies between blocks that
    are in use: once a large environment is set up, that is more than all these. Where the C library cannot,
    nothing happens."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


def _refusal(nbytes: int, content: Content, reason: str | None) -> HeadwayError:
    return HeadwayError(
        f"no {nbytes / 2**20:.0f} MiB of shared memory for {content} ({reason}); lower {_LOWER[content]}"
    )


def _attach(descriptor: Any, nbytes: int) -> SharedBlock:  # noqa: ANN401 - a private class of multiprocessing
    return SharedBlock(descriptor.detach(), nbytes)


def _anonymous_file() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("headway")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
