"""Loading of trained policies."""

import warnings
from pathlib import Path

from headway.contracts import HeadwayError
from headway.policies.files import read_policy
from headway.policies.policy import Policy, numpy_evaluation


def load_policy(source: str | Path, best: bool = False) -> Policy:
    """Load a trained policy from a run's folder or a file written by `headway export`.

    A run's folder may have been copied from its store; its newest checkpoint is read, with torch, and acting
    needs numpy only. `best`: the policy with the highest mean return in the evaluations of the run's training
    instead of the newest. A file .npz needs nothing but numpy; .onnx needs onnxruntime. A TorchScript file is
    a program and is refused; use `torch.jit.load` for files that you trust. No environment is created, except
    for runs of earlier versions, which did not store its specification.

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
