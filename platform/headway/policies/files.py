"""Files of trained policies: npz, ONNX and TorchScript, each with the policy's description in JSON.

An ONNX or TorchScript file computes `headway.policies.network.Evaluation` (actions, outputs, next state) from
`observations` (B, N, D) float32 and, where the policy has them, `masks` (B, N, A) bool and `state` (B, N, M).
"""

import io
import warnings
import zipfile
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from headway.contracts.errors import HeadwayError, one_line
from headway.policies.description import Arrays, PolicyDescription
from headway.policies.network import Evaluation, evaluate
from headway.policies.policy import Array, Evaluate, Policy, numpy_evaluation

_ENTRY = "headway.json"
"""Name of the description in a file."""
_OUTPUTS = ("actions", "outputs", "next_state")


def _npz_bytes(description: PolicyDescription, arrays: Arrays) -> bytes:
    stream = io.BytesIO()
    named: dict[str, Any] = {_ENTRY: np.array(description.to_json()), **arrays}
    np.savez_compressed(stream, **named)
    return stream.getvalue()


def _read_npz(path: Path) -> Policy:
    if not zipfile.is_zipfile(path):  # numpy would advise to load it unsafely
        raise ValueError("it is not an npz file")
    with np.load(path, allow_pickle=False) as stored:
        description = PolicyDescription.from_json(str(stored[_ENTRY]))
        if description.network.hidden_layers > len(stored.files):
            raise ValueError("it lacks arrays")
        arrays = {name: stored[name] for name in description.network.array_names}
    return Policy(description, numpy_evaluation(description, arrays))


def _torchscript_bytes(description: PolicyDescription, arrays: Arrays) -> bytes:
    import torch

    stream = io.BytesIO()
    module, _ = _traced(description, arrays)
    torch.jit.save(module, stream, _extra_files={_ENTRY: description.to_json()})
    return stream.getvalue()


def _read_torchscript(path: Path) -> Policy:
    import torch

    extra = {_ENTRY: ""}
    load: Any = torch.jit.load
    module = load(str(path), map_location="cpu", _extra_files=extra)
    description = PolicyDescription.from_json(extra[_ENTRY])

    def run(inputs: Mapping[str, Array]) -> list[Array]:
        with torch.no_grad():
            return [result.numpy() for result in module(*map(torch.as_tensor, inputs.values()))]

    return Policy(description, _evaluation(description, run))


def _onnx_bytes(description: PolicyDescription, arrays: Arrays) -> bytes:
    import torch

    onnx = _imported("onnx")
    module, inputs = _traced(description, arrays)
    stream: Any = io.BytesIO()
    outputs = _OUTPUTS if description.network.hidden_size else _OUTPUTS[:2]
    with warnings.catch_warnings():
        # The newer exporter takes half a minute, prints its progress and needs another package.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            tuple(inputs.values()),
            stream,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes={name: {0: "batch"} for name in (*inputs, *outputs)},
            dynamo=False,
        )
    model = onnx.load_model_from_string(stream.getvalue())
    onnx.helper.set_model_props(model, {_ENTRY: description.to_json()})
    return bytes(model.SerializeToString())


def _read_onnx(path: Path) -> Policy:
    session = _imported("onnxruntime").InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    description = PolicyDescription.from_json(session.get_modelmeta().custom_metadata_map[_ENTRY])
    return Policy(description, _evaluation(description, lambda inputs: session.run(None, dict(inputs))))


def _imported(package: str) -> ModuleType:
    try:
        return import_module(package)
    except ImportError as error:
        raise HeadwayError(
            f'ONNX files need the package {error.name}; install it with pip install "headway[export]"'
        ) from error


def _evaluation(
    description: PolicyDescription, run: Callable[[Mapping[str, Array]], list[Array]]
) -> Evaluate:
    """Return the evaluation by a stored graph; `run` maps its inputs by name to its outputs."""

    def evaluate_graph(observations: Array, masks: Array | None, state: Array | None) -> Evaluation:
        given = {"observations": observations, "masks": masks, "state": state}
        results = run({name: array for name, array in given.items() if array is not None})
        return Evaluation(*results, *[None] * (len(Evaluation._fields) - len(results)))

    return evaluate_graph


def _traced(description: PolicyDescription, arrays: Arrays) -> tuple[Any, dict[str, Any]]:
    """Return the policy as a traced torch module and, by name, inputs of two copies."""
    import torch

    network, agents = description.network, len(description.agents)
    inputs = {"observations": torch.zeros(2, agents, description.observation_size)}
    if description.has_action_mask:
        inputs["masks"] = torch.ones(2, agents, sum(description.action_space.options), dtype=torch.bool)
    dtype = getattr(torch, description.precision)
    if network.hidden_size:
        inputs["state"] = torch.zeros(2, agents, network.hidden_size, dtype=dtype)

    class Module(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            for name, array in {**description.constants, **arrays}.items():
                self.register_buffer(name, torch.as_tensor(array).clone())

        def forward(self, *given: torch.Tensor) -> tuple[torch.Tensor, ...]:
            named, buffers = dict(zip(inputs, given, strict=True)), dict(self.named_buffers())
            results = evaluate(
                torch,
                description,
                buffers,
                named["observations"].to(dtype),
                named.get("masks"),
                named.get("state"),
            )
            return tuple(result for result in results if result is not None)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchScript is deprecated, but what `headway export` was asked for
        trace: Any = torch.jit.trace
        return trace(Module().eval(), tuple(inputs.values())), inputs


class Format(NamedTuple):
    """A format of policies' files."""

    suffix: str
    contents: Callable[[PolicyDescription, Arrays], bytes]
    """Returns the contents of a policy's file. Raises as `require_packages`."""
    read: Callable[[Path], Policy]
    packages: tuple[str, ...] = ()
    """Optional packages that writing and reading need."""

    def require_packages(self) -> None:
        """Raise HeadwayError if one of the packages is not installed."""
        for package in self.packages:
            _imported(package)


FORMATS: Mapping[str, Format] = {
    "npz": Format(".npz", _npz_bytes, _read_npz),
    "onnx": Format(".onnx", _onnx_bytes, _read_onnx, ("onnx", "onnxruntime")),
    "torchscript": Format(".pt", _torchscript_bytes, _read_torchscript),
}


def read_policy(path: Path) -> Policy:
    """Read a policy's file, in the format given by its suffix. Reading TorchScript runs code in the file.

    Raises HeadwayError if it cannot be read, is damaged or was not written by `headway export`.
    """
    readers = {form.suffix: form.read for form in FORMATS.values()}
    if path.suffix not in readers:
        raise HeadwayError(f"{path} must be a run's folder or a file ending in {', '.join(readers)}")
    if not path.is_file():
        raise HeadwayError(f"there is no file {path}")
    try:
        policy = readers[path.suffix](path)
        agents, options = len(policy.agents), sum(policy.description.action_space.options)
        masks = np.ones((agents, options), np.bool_) if policy.description.has_action_mask else None
        policy.act(np.zeros((agents, policy.observation_size)), masks)
    except HeadwayError:
        raise
    except Exception as error:  # what the libraries raise for damaged files has no common type
        raise HeadwayError(
            f"{path} is damaged or not a policy: export it again with `headway export` ({one_line(error)})"
        ) from error
    return policy


def load_policy(source: str | Path, best: bool = False) -> Policy:
    """Load a trained policy from a run's folder or a file written by `headway export`.

    A run's folder may have been copied from its store; its newest checkpoint is read, with torch, and acting
    needs numpy only. `best`: the policy with the highest mean return in the evaluations of the run's training
    instead of the newest. A file .npz needs nothing but numpy; .onnx needs onnxruntime. A TorchScript file is
    a program and is refused; use `torch.jit.load` for files that you trust. No environment is created.

    Warns of broken checkpoints that are skipped. Raises HeadwayError if the folder or file is not a policy's,
    is damaged, or lacks a checkpoint.
    """
    path = Path(source)
    if path.suffix == ".pt" and path.is_file():
        raise HeadwayError(
            f"{path}: a TorchScript file is a program: load one that you trust with torch.jit.load; "
            "load_policy reads .npz and .onnx"
        )
    if not path.is_dir():
        if best:
            raise HeadwayError(f"{path}: a file holds one policy: omit best, or name the run's folder")
        return read_policy(path)
    from headway.policies.trained_run import TrainedRun

    run = TrainedRun.read(path, best)
    for line in run.notices:
        warnings.warn(line, stacklevel=2)
    return Policy(run.description, numpy_evaluation(run.description, run.arrays))
