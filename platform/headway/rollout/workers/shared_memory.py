"""Shared memory that is released with the last process that uses it, even if all of them are killed.

A block is an anonymous file (memfd on Linux), passed by descriptor. It has no name in /dev/shm that a killed
process could leave behind, and does not depend on the size of that mount.
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
"""Settings that make a block smaller or leave more room for it, by content of the block."""


class SharedBlock:
    """A block of `nbytes` bytes, shared with processes that receive it when they start."""

    def __init__(self, descriptor: int, nbytes: int) -> None:
        self._descriptor, self.nbytes = descriptor, nbytes
        self._map = mmap.mmap(descriptor, max(nbytes, 1))

    @classmethod
    def create(cls, nbytes: int, content: Content = "trajectories") -> Self:
        """Return a new block of zeros. Raises HeadwayError, naming `content`, if memory is too short."""
        available = available_memory()
        if available is not None and nbytes > available:
            # Checked here because an anonymous file has no size limit: the system would kill a process.
            raise _refusal(nbytes, content, f"{available / 2**20:.0f} MiB are free")
        try:
            descriptor = _anonymous_file()
        except OSError as error:
            raise _refusal(nbytes, content, error.strerror) from error
        try:
            # Allocated now: a process that touches a page for which memory is missing would be killed.
            os.posix_fallocate(descriptor, 0, max(nbytes, 1))
            return cls(descriptor, nbytes)
        except OSError as error:
            os.close(descriptor)
            raise _refusal(nbytes, content, error.strerror) from error

    @property
    def buffer(self) -> mmap.mmap:
        """The shared memory map."""
        return self._map

    def private(self) -> mmap.mmap:
        """Return a copy-on-write map of the block: writes stay private to this map.

        Pages not yet written still show the block, which must therefore not be written to any more.
        """
        return mmap.mmap(self._descriptor, max(self.nbytes, 1), access=mmap.ACCESS_COPY)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the block for a process that is being started, with a duplicate of the descriptor."""
        return _attach, (reduction.DupFd(self._descriptor), self.nbytes)

    def close(self) -> None:
        """Close the descriptor; arrays over the memory stay valid. Closing again has no effect."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1


@dataclass(frozen=True)
class SharedPickle(Generic[ValueT]):
    """An object pickled into a shared block, so that many workers share the memory of its arrays.

    Arrays of a loaded object lie in the block, mapped copy-on-write: each process may write to its own.
    """

    block: SharedBlock
    parts: tuple[slice, ...]
    """Byte ranges in the block: first of the pickle, then of each array."""
    mentions_main: bool
    """The pickle refers to the main module."""

    @classmethod
    def of(cls, value: ValueT) -> Self:
        """Pickle `value`. Raises HeadwayError if memory is too short, and any error of pickling."""
        # Protocol 5 keeps arrays out of the pickle, so that workers map them instead of copying them.
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
        """Return a new copy of the object, with private arrays."""
        memory = memoryview(self.block.private())
        pickled, *arrays = (memory[part] for part in self.parts)
        value: ValueT = pickle.loads(pickled, buffers=arrays)
        return value


def give_back_memory() -> None:
    """Return freed memory to the system, if the C library can."""
    # glibc keeps freed memory that lies between blocks in use: after the set-up of a large environment, this
    # can be more than the memory in use.
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
    # Without memfd (macOS), a temporary file that is deleted at once is nameless too.
    if hasattr(os, "memfd_create"):
        return os.memfd_create("headway")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
