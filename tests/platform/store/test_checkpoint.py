"""Checkpoints are restored exactly, and broken ones are detected."""

import hashlib
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from headway.contracts import Discrete, EnvSpec, HeadwayError
from headway.store.checkpoint import (
    _MAGIC,
    latest_iteration,
    load_latest,
    require_same_shapes,
    save_checkpoint,
    write_checkpoint,
)
from headway_algos.registry import ENTRIES, configure


def _state() -> dict[str, object]:
    generator = np.random.Generator(np.random.Philox(7))
    return {
        "weights": torch.randn(3, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64),
        "adam": {0: {"step": 3, "moment": torch.zeros(2, dtype=torch.bfloat16)}},
        "numpy": np.arange(6, dtype=np.uint64).reshape(2, 3),
        "names": np.array(["ä", "bc"]),
        "scalar": np.float32(0.1),
        "empty": np.zeros((0, 4)),
        "snapshot": b"\x00\xffraw",
        "mixed": [1, 2.5, "three", None, True, (4, 1 << 90)],
        "stream": generator.bit_generator.state,
    }


def test_state_comes_back_exactly(tmp_path: Path) -> None:
    state = _state()
    save_checkpoint(tmp_path, 20, state)
    iteration, loaded, notices = load_latest(tmp_path)
    assert (iteration, notices) == (20, ())
    assert set(loaded) == set(state)
    assert torch.equal(loaded["weights"], state["weights"])  # type: ignore[arg-type] # known to be a tensor
    assert loaded["adam"][0]["step"] == 3
    assert loaded["adam"][0]["moment"].dtype == torch.bfloat16
    for name in ("numpy", "names", "empty"):
        np.testing.assert_array_equal(loaded[name], state[name])
        assert loaded[name].dtype == np.asarray(state[name]).dtype
    assert type(loaded["scalar"]) is np.float32
    assert loaded["scalar"] == np.float32(0.1)
    assert loaded["snapshot"] == state["snapshot"]
    assert loaded["mixed"] == state["mixed"]
    revived = np.random.Generator(np.random.Philox())
    revived.bit_generator.state = loaded["stream"]
    assert revived.random() == np.random.Generator(np.random.Philox(7)).random()


def test_the_last_two_are_kept(tmp_path: Path) -> None:
    for iteration in (20, 40, 60):
        save_checkpoint(tmp_path, iteration, {"at": iteration})
    kept = sorted(path.name for path in tmp_path.iterdir())
    assert kept == ["checkpoint-000040.pt", "checkpoint-000060.pt"]
    assert latest_iteration(tmp_path) == 60


def test_replay_data_are_kept_as_long_as_their_checkpoints(tmp_path: Path) -> None:
    """Only the first two checkpoints have some, as when a rule has acted in the first iterations."""
    left = []
    for iteration in (1, 2, 3, 4):
        if iteration < 3:
            write_checkpoint(tmp_path, iteration, b"data", kind="experience")
        save_checkpoint(tmp_path, iteration, {"at": iteration})
        left.append(sorted(path.stem for path in tmp_path.glob("experience-*")))
    first, second = "experience-000001", "experience-000002"
    assert left == [[first], [first, second], [second], []]


@pytest.mark.parametrize("damage", ["cut", "flip", "empty"])
def test_a_broken_checkpoint_is_skipped(tmp_path: Path, damage: str) -> None:
    save_checkpoint(tmp_path, 20, {"at": 20})
    path = save_checkpoint(tmp_path, 40, {"at": 40, "weights": torch.ones(1000)})
    content = bytearray(path.read_bytes())
    if damage == "flip":
        content[-100] ^= 1
    path.write_bytes(content[: {"cut": len(content) // 2, "flip": len(content), "empty": 0}[damage]])
    iteration, state, notices = load_latest(tmp_path)
    assert (iteration, state) == (20, {"at": 20})
    assert len(notices) == 1
    assert "checkpoint-000040.pt" in notices[0]


def test_no_valid_checkpoint_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(HeadwayError, match="no checkpoint in"):
        load_latest(tmp_path)
    (tmp_path / "checkpoint-000020.pt").write_bytes(b"half")
    with pytest.raises(HeadwayError, match="is broken: start a new run"):
        load_latest(tmp_path)


def test_objects_with_code_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"state\['env'\]\[0\] is a PosixPath"):
        save_checkpoint(tmp_path, 1, {"env": [tmp_path]})


def test_a_device_in_the_place_of_a_checkpoint_is_skipped(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, 20, _state())
    (tmp_path / "checkpoint-000040.pt").symlink_to("/dev/zero")
    iteration, _, notices = load_latest(tmp_path)
    assert iteration == 20
    assert "it is not a regular file" in notices[0]


def test_a_checkpoint_whose_parameters_are_no_mapping_is_broken(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, 20, _state())
    save_checkpoint(tmp_path, 40, {**_state(), "acting": 1.5})
    iteration, _, notices = load_latest(tmp_path)
    assert iteration == 20
    assert "it holds no state" in notices[0]


def test_a_pickle_with_a_right_checksum_is_not_loaded(tmp_path: Path) -> None:
    """The error does not repeat torch's advice to load the file unsafely."""
    save_checkpoint(tmp_path, 20, _state())
    (path,) = tmp_path.glob("checkpoint-*.pt")
    content = pickle.dumps(Path)
    path.write_bytes(_MAGIC + hashlib.sha256(content).digest() + content)
    with pytest.raises(HeadwayError, match="holds objects other than tensors") as refusal:
        load_latest(tmp_path)
    assert "weights_only" not in str(refusal.value)


def test_a_view_is_stored_without_its_whole_storage(tmp_path: Path) -> None:
    path = save_checkpoint(tmp_path, 1, {"row": torch.zeros(1_000_000)[:10]})
    assert path.stat().st_size < 10_000


def test_parameters_of_another_kind_are_damage(tmp_path: Path) -> None:
    policy = ENTRIES["ippo"].acting_policy(configure("ippo"), EnvSpec("made", ("a",), 3, Discrete(2)))
    parameters = {name: np.zeros(shape, dtype) for name, (shape, dtype) in policy.parameter_shapes(1).items()}
    require_same_shapes(parameters, policy, 1, "made", tmp_path)
    wrong = {**parameters, "bias_0": parameters["bias_0"].astype(np.complex128)}
    with pytest.raises(HeadwayError, match="is damaged: its bias_0 is of type complex128"):
        require_same_shapes(wrong, policy, 1, "made", tmp_path)
