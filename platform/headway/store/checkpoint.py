"""Checkpoints with a checksum, loaded without executing code from the file.

A file is a magic line, the SHA-256 of the rest, and the output of `torch.save`. Replay data, which can be
large (a replay buffer, or a rule's decisions until they are imitated), are stored in a separate file beside
the checkpoint and removed when the run has finished.
"""

import hashlib
import io
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from headway.contracts import HeadwayError
from headway.contracts.acting_policy import ActingPolicy, Parameters
from headway.store.atomic_files import make_folder, remove_partial, sync_folder
from headway.store.fencing import discard, write_through
from headway.store.run_folder import CHECKPOINTS

_MAGIC = b"headway checkpoint 1\n"
_NAMES = {kind: re.compile(rf"{kind}-(\d{{6,}})\.pt") for kind in ("checkpoint", "experience")}
_KEPT = 2
_KIND = "__headway__"


def save_checkpoint(directory: Path, iteration: int, state: Mapping[str, Any]) -> Path:
    """Serialise `state` and write it as the checkpoint of `iteration`.

    Raises ValueError for a value of an unsupported type, and HeadwayError if the file cannot be written.
    """
    return write_checkpoint(directory, iteration, checkpoint_bytes(state))


def checkpoint_bytes(state: Mapping[str, Any]) -> bytes:
    """Return the contents of a checkpoint file.

    `state` holds tensors, numpy arrays and scalars, numbers, strings, bytes, None, and lists, tuples and
    dicts of these. Raises ValueError, with the path to the value, for any other type.
    """
    import torch

    payload = io.BytesIO()
    torch.save(_encoded(state, "state"), payload)
    content = payload.getbuffer()
    return b"".join((_MAGIC, hashlib.sha256(content).digest(), content))


def write_checkpoint(
    directory: Path, iteration: int, content: bytes, gate: Path | None = None, kind: str = "checkpoint"
) -> Path:
    """Write the checkpoint of `iteration` durably; keep the last two, with their replay data.

    `gate`: see `headway.store.fencing`; None: write without one. `kind`: `experience` for replay data, which
    are written before the checkpoint that they belong to. Raises HeadwayError if the file cannot be written;
    earlier files are then unchanged.
    """
    path = directory / f"{kind}-{iteration:06d}.pt"
    make_folder(directory)
    remove_partial(directory, f"{kind}-")
    write_through(path, lambda stream: stream.write(content), gate)
    if kind == "checkpoint":
        oldest = _files(directory, kind)[:_KEPT][-1][0]
        for name in _NAMES:
            for at, older in _files(directory, name):
                if at < oldest:
                    discard(older, gate)
    sync_folder(directory)
    return path


def remove_replay(directory: Path, gate: Path | None) -> None:
    """Delete all stored replay data of a finished run. Raises HeadwayError if the gate has been closed."""
    for _, path in _files(directory, "experience"):
        discard(path, gate)


def rewind_checkpoints(directory: Path, iteration: int, gate: Path | None) -> None:
    """Remove all checkpoints and replay data newer than `iteration`, from which training could not resume.

    By their names they would count as the newest. Raises HeadwayError if the gate has been closed.
    """
    for kind in _NAMES:
        for newer, path in _files(directory, kind):
            if newer > iteration:
                discard(path, gate)


def load_for_resume(*directories: Path) -> tuple[int, dict[str, Any], tuple[str, ...]]:
    """Load the newest checkpoint from which training can resume, with its replay data.

    Arguments, result and errors are those of `load_latest`; the state also contains the replay data as
    `replay` (None: the learner has none). A stack stores it in only one of its folders.
    """
    return _newest_valid(directories, _with_replay(directories))


def load_latest(*directories: Path) -> tuple[int, dict[str, Any], tuple[str, ...]]:
    """Return (iteration, state, notices) of the newest valid checkpoint, with tensors on the CPU.

    The folders, one per seed of a stack, hold copies of the same checkpoints; some may be missing. A notice
    is one line about a broken checkpoint that was skipped. Raises HeadwayError if none is valid.
    """
    return _newest_valid(directories, _load)


def _with_replay(directories: Sequence[Path]) -> Callable[[Path], dict[str, Any]]:
    def load(path: Path) -> dict[str, Any]:
        state = _load(path)
        if not state.get("has_experience", False):
            return {**state, "replay": None}
        name = path.name.replace("checkpoint", "experience")
        found = [directory / name for directory in directories if (directory / name).exists()]
        if not found:
            raise ValueError(f"its replay data {name} are missing")
        try:
            return {**state, "replay": _load(found[0])}
        except ValueError as error:
            raise ValueError(f"its replay data {name} are broken: {error}") from error

    return load


def _newest_valid(
    directories: Sequence[Path], load: Callable[[Path], dict[str, Any]]
) -> tuple[int, dict[str, Any], tuple[str, ...]]:
    notices: list[str] = []
    found = [entry for directory in directories for entry in _files(directory, "checkpoint")]
    # The sort is stable: within an iteration the first folder's checkpoint comes first.
    for iteration, path in sorted(found, key=lambda entry: -entry[0]):
        try:
            return iteration, load(path), tuple(notices)
        except (OSError, ValueError) as error:
            notices.append(f"checkpoint {path.name} is broken ({error}) and was skipped")
    where = " or ".join(str(directory) for directory in directories)
    if notices:
        raise HeadwayError(f"every checkpoint in {where} is broken: start a new run ({'; '.join(notices)})")
    raise NoCheckpointError(directories[0].parent.name, f"there is no checkpoint in {where}")


class NoCheckpointError(HeadwayError):
    """A run has no checkpoint."""

    def __init__(self, run: str, line: str) -> None:
        """`run`: name of its folder."""
        super().__init__(f"{line}: train longer or anew")
        self.run = run


class UnfitPolicyError(HeadwayError):
    """A checkpoint's policies do not fit the environment."""


def require_same_shapes(
    parameters: Parameters, policy: ActingPolicy, replicas: int, environment: str, run: Path
) -> None:
    """Raise UnfitPolicyError if a checkpoint's arrays do not have the shapes of `policy`.

    `parameters` are those of `replicas` replicas, from the run folder `run`. Raises HeadwayError for arrays
    of another kind, such as complex numbers.
    """
    # A run is loaded with its stored configuration, so shapes differ only if the environment has changed.
    for name, (shape, dtype) in policy.parameter_shapes(replicas).items():
        if name not in parameters or np.shape(parameters[name]) != shape:
            raise UnfitPolicyError(
                f"run {run.name} was trained on a version of {environment} with other observations, actions "
                "or agents; train it again"
            )
        if (kind := np.asarray(parameters[name]).dtype).kind != dtype.kind:
            raise HeadwayError(f"a checkpoint of run {run.name} is damaged: its {name} is of type {kind}")


def stored_parameters(
    run: Path, policy: ActingPolicy, seed: int, stack: Sequence[int], environment: str, best: bool = False
) -> tuple[int, Parameters, tuple[str, ...]]:
    """Return (iteration, acting parameters of `seed`, notices) of a run's newest valid checkpoint.

    `run` is the run's folder, `stack` the seeds in its checkpoints. `best`: the parameters at the evaluation
    with the highest return instead of the newest. Notices are those of `load_latest`. Raises HeadwayError if
    there is no valid checkpoint, or if it does not fit `policy` or is not finite.
    """
    iteration, state, notices = load_latest(run / CHECKPOINTS)
    place, replicas = stack.index(seed), len(stack)
    if best:
        state = state.get("best", {})
        iteration = int(state["iterations"][place]) if state else -1
        if iteration < 0:
            raise HeadwayError(
                f"the checkpoints of run {run.name} do not hold its best policies: it was trained with an "
                "earlier version, or every evaluation returned NaN; take the newest ones, or train it again"
            )
    require_same_shapes(state["acting"], policy, replicas, environment, run)
    own = {name: np.split(np.asarray(a), replicas)[place] for name, a in state["acting"].items()}
    for name, array in own.items():
        if not np.isfinite(array).all():
            raise HeadwayError(f"run {run.name} diverged: its policy's {name} is not finite")
    return iteration, own, notices


def latest_iteration(directory: Path) -> int | None:
    """Return the iteration in the name of the newest checkpoint, without reading it; None: no checkpoint."""
    checkpoints = _files(directory, "checkpoint")
    return checkpoints[0][0] if checkpoints else None


def newest_file(directory: Path) -> Path | None:
    """Return the path of the newest checkpoint, without reading it; None: no checkpoint."""
    return next((path for _, path in _files(directory, "checkpoint")), None)


def _files(directory: Path, kind: str) -> list[tuple[int, Path]]:
    """Return (iteration, path) of the files of a kind, newest first."""
    matches = ((_NAMES[kind].fullmatch(path.name), path) for path in directory.glob(f"{kind}-*.pt"))
    return sorted(((int(match[1]), path) for match, path in matches if match), reverse=True)


def _load(path: Path) -> dict[str, Any]:
    import pickle

    import torch

    if not path.is_file():
        raise ValueError("it is not a regular file")
    content = path.read_bytes()
    header = len(_MAGIC) + hashlib.sha256().digest_size
    if not content.startswith(_MAGIC):
        raise ValueError("it does not begin with the checkpoint header")
    if hashlib.sha256(memoryview(content)[header:]).digest() != content[len(_MAGIC) : header]:
        raise ValueError("its checksum does not match")
    try:
        state = torch.load(io.BytesIO(memoryview(content)[header:]), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:  # whose text advises to load it unsafely
        raise ValueError("it holds objects other than tensors, numbers and strings") from error
    except (RuntimeError, EOFError) as error:
        raise ValueError("torch cannot read its content") from error
    decoded = _decoded(state)
    if not (isinstance(decoded, dict) and isinstance(decoded.get("acting", {}), dict)):
        raise ValueError("it holds no state")
    return decoded


def _encoded(value: Any, place: str) -> Any:  # noqa: ANN401 - any allowed leaf or container
    import torch

    match value:
        case torch.Tensor():
            # Saving a view would write its whole storage.
            return value.detach().cpu().clone()
        case np.ndarray() | np.generic():
            return _encoded_array(value, place)
        case bytes() | bytearray():
            return {_KIND: "bytes", "data": _byte_tensor(bytes(value))}
        case None | bool() | int() | float() | str():
            return value
        case Mapping():
            return {
                _encoded_key(key, place): _encoded(item, f"{place}[{key!r}]") for key, item in value.items()
            }
        case list() | tuple():
            items = [_encoded(item, f"{place}[{index}]") for index, item in enumerate(value)]
            return items if isinstance(value, list) else tuple(items)
    raise ValueError(
        f"{place} is a {type(value).__name__}: a checkpoint holds tensors, arrays, numbers, strings, bytes, "
        "and lists, tuples and dicts of these"
    )


def _encoded_key(key: Any, place: str) -> Any:  # noqa: ANN401
    if key == _KIND or not isinstance(key, str | int | float | bool | tuple):
        raise ValueError(f"{place} has the key {key!r}: keys are strings or numbers")
    return key


def _encoded_array(value: "np.ndarray[Any, Any] | np.generic", place: str) -> dict[str, Any]:
    array = np.asarray(value)
    if array.dtype.hasobject or array.dtype.names is not None:
        raise ValueError(f"{place} is an array of {array.dtype}: give arrays of numbers or strings")
    return {
        _KIND: "array" if isinstance(value, np.ndarray) else "scalar",
        "dtype": array.dtype.str,
        "shape": tuple(array.shape),
        "data": _byte_tensor(np.ascontiguousarray(array).tobytes()),
    }


def _byte_tensor(content: bytes) -> Any:  # noqa: ANN401 - torch is imported only where needed
    import torch

    if not content:
        return torch.empty(0, dtype=torch.uint8)
    return torch.frombuffer(bytearray(content), dtype=torch.uint8)


def _decoded(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, dict):
        decode = _DECODERS.get(value.get(_KIND, ""))
        return decode(value) if decode else {key: _decoded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_decoded(item) for item in value]
    if isinstance(value, tuple):
        return tuple(_decoded(item) for item in value)
    return value


def _array(value: dict[str, Any]) -> "np.ndarray[Any, Any]":
    return np.frombuffer(bytearray(_bytes(value)), np.dtype(value["dtype"])).reshape(value["shape"])


def _bytes(value: dict[str, Any]) -> bytes:
    return bytes(value["data"].numpy().tobytes())


_DECODERS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "bytes": _bytes,
    "array": _array,
    "scalar": lambda value: _array(value)[()],
}
