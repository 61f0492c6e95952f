"""The device that a learner computes on."""

import torch

from headway.contracts import HeadwayError


def resolve_device(device: str) -> torch.device:
    """Return the torch device; `auto` is a GPU if available. Raises HeadwayError for an unavailable one."""
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise HeadwayError("device: cuda needs a GPU, and torch finds none; use device=auto or device=cpu")
    try:
        return torch.device(device)
    except RuntimeError:
        raise HeadwayError(f"device: {device!r} is not a device; use device=auto, cpu or cuda") from None
