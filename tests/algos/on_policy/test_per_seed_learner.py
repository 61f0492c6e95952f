"""A seed trains the same in any stack: bit for bit with on-policy algorithms, whatever the rounding;
with `madqn` and `ddpg` if products of a stack round like single ones. Training is resumed exactly."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from covering import quick_or_slow
from learned import assert_close, assert_equal, joined, reloaded, tensors
from made_trajectories import BOX, DISCRETE, TEAM, fabricate
from numpy.typing import NDArray
from torch.utils._python_dispatch import TorchDispatchMode

from headway.config.schema import build
from headway.contracts import EnvSpec, Learner, LearnerWithReplay, Trajectory
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.on_policy.split_learner import SplitLearner
from headway_algos.registry import ENTRIES

SEEDS = (3, 5, 7)
SMALL: dict[str, Any] = {"policies": "independent", "model": {"hidden": (8, 8)}, "lr_end": 0.1}
GATED: dict[str, Any] = {"model": {"hidden": (8,), "core": "gru", "gru_size": 4}}
# So small that every batch is cut into several pieces.
ON_POLICY: dict[str, Any] = {**SMALL, "piece_samples": 60}
STEPS: dict[str, Any] = {**ON_POLICY, "minibatches": 3, "epochs": 2}
KFAC = {"critic": "central", "update": "kfac", "critic_update": "kfac"}
REPLAY: dict[str, Any] = {**SMALL, "capacity": 60, "learning_starts": 5, "batch_size": 7, "updates": 4}
CASES: dict[str, tuple[str, dict[str, Any], EnvSpec]] = {
    "ippo": ("ippo", {**STEPS, "kl_coeff": 0.2}, DISCRETE),
    "ippo, float64": ("ippo", {**STEPS, "precision": "float64"}, BOX),
    "ippo, shared until half": ("ippo", {**STEPS, "shared_until": 0.3}, BOX),
    "ippo, recurrent": ("ippo", {**STEPS, **GATED, "policies": "groups"}, DISCRETE),
    "mappo": ("mappo", {**STEPS, "policies": "shared", "critic_actions": "others"}, DISCRETE),
    "happo": ("happo", STEPS, TEAM),
    "ia2c": ("ia2c", ON_POLICY, BOX),
    "maa2c": ("maa2c", ON_POLICY, TEAM),
    "coma": ("coma", ON_POLICY, DISCRETE),
    "coma, recurrent, shared at first": ("coma", {**ON_POLICY, **GATED, "shared_until": 0.1}, TEAM),
    "itrpo": ("itrpo", ON_POLICY, BOX),
    "itrpo, shared": ("itrpo", {**ON_POLICY, "policies": "shared"}, DISCRETE),
    "matrpo": ("matrpo", ON_POLICY, TEAM),
    "hatrpo, recurrent": ("hatrpo", {**ON_POLICY, **GATED, "cg_iterations": 2}, TEAM),
    "maacktr": ("maacktr", {**ON_POLICY, "policies": "shared"}, DISCRETE),
    "k-fac in turns": ("custom", {**ON_POLICY, **KFAC, "order": "sequential"}, TEAM),
    "madqn": ("madqn", {**REPLAY, "n_step": 3}, replace(DISCRETE, snapshots=True)),
    "madqn, shared": ("madqn", {**REPLAY, "policies": "shared"}, replace(DISCRETE, snapshots=True)),
    "ddpg": ("ddpg", {**REPLAY, "policies": "groups"}, replace(BOX, snapshots=True)),
}
QUICK = ("ippo, shared until half", "coma")
every_case = pytest.mark.parametrize(
    ("name", "settings", "spec"), quick_or_slow(CASES, *QUICK, "maacktr", "madqn")
)
on_policy_case = pytest.mark.parametrize(
    ("name", "settings", "spec"),
    quick_or_slow({case: values for case, values in CASES.items() if "capacity" not in values[1]}, *QUICK),
)


class RoundsByShape(TorchDispatchMode):
    """Matrix products with a relative error that depends on their shapes, like rounding."""

    PRODUCTS = ("aten::bmm", "aten::baddbmm", "aten::baddbmm_", "aten::mm", "aten::addmm")

    def __init__(self, batch: bool) -> None:
        """`batch`: also on the number of matrices multiplied at once."""
        super().__init__()
        self.batch = batch

    def __torch_dispatch__(  # type: ignore[no-untyped-def]
        self,
        func,  # noqa: ANN001
        types,  # noqa: ANN001
        args=(),  # noqa: ANN001
        kwargs=None,  # noqa: ANN001
    ) -> Any:  # noqa: ANN401
        result = func(*args, **(kwargs or {}))
        if func.name().split(".")[0] in self.PRODUCTS:
            left, right = args[-2:]
            sizes = (*left.shape[-2:], right.shape[-1], len(left) if self.batch else 1)
            result.mul_(1 + 1e-4 * (hash(sizes) % 97) / 97)
        return result


def _learner(name: str, settings: dict[str, Any], spec: EnvSpec, seeds: tuple[int, ...]) -> Learner:
    entry = ENTRIES[name]
    return entry.learner(build(entry.record_for(settings), settings, "algo", name), spec, seeds, "cpu")


def _experience(spec: EnvSpec, iteration: int, settings: dict[str, Any]) -> list[Trajectory]:
    """One trajectory per seed: with all, few and hardly any agents alive."""
    memory = settings["model"].get("gru_size", 0)
    return [
        fabricate(spec, 12, 3, 10 * iteration + r, absent=absent, idle=0.2, leaves=0.02, hidden_size=memory)
        for r, absent in enumerate((0.0, 0.5, 0.95))
    ]


def _trained(
    learner: Learner, tracks: list[Trajectory], done: int = 0
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """State tensors and acting parameters after training, and the metrics of the last iteration."""
    metrics: dict[str, NDArray[Any]] = {}
    for i, track in enumerate(tracks, start=done):
        metrics = learner.update(track, i + 1, 0.2 * i)
    return {**tensors(learner.state_dict()), **learner.acting_parameters()}, metrics


@every_case
def test_a_seed_learns_the_same_in_any_stack(name: str, settings: dict[str, Any], spec: EnvSpec) -> None:
    tracks = [_experience(spec, iteration, settings) for iteration in (1, 2)]
    with RoundsByShape(batch=name not in ("madqn", "ddpg")):
        stacked = _learner(name, settings, spec, SEEDS)
        whole, of_all = _trained(stacked, [joined(track) for track in tracks], done=1)
        for r in (0, 2):  # with all agents alive and with hardly any
            learner = _learner(name, settings, spec, SEEDS[r : r + 1])
            alone, of_one = _trained(learner, [track[r] for track in tracks], done=1)
            assert_equal({key: np.split(array, len(SEEDS))[r] for key, array in whole.items()}, alone)
            assert_equal({key: values[r : r + 1] for key, values in of_all.items()}, of_one)


@pytest.mark.parametrize("name", ["itrpo", "maacktr"])
def test_products_over_several_seeds_would_be_detected(name: str) -> None:
    """A learner that stacks seeds, as on a GPU, differs from one seed alone, so the test of stacks can fail.

    Only natural gradients use products of torch, which may depend on the stack.
    """
    settings = CASES[name][1]
    tracks = [_experience(DISCRETE, iteration, settings) for iteration in (1, 2)]
    config = build(ENTRIES[name].config, settings, "algo", name)
    with RoundsByShape(batch=False):
        whole, _ = _trained(
            OnPolicyLearner(config, DISCRETE, SEEDS, "cpu"), [joined(track) for track in tracks]
        )
        alone, _ = _trained(OnPolicyLearner(config, DISCRETE, (5,), "cpu"), [track[1] for track in tracks])
    assert not np.array_equal(np.split(whole["weight_0"], len(SEEDS))[1], alone["weight_0"])


@every_case
def test_resumed_training_is_exact(name: str, settings: dict[str, Any], spec: EnvSpec) -> None:
    """Checkpoints are from before and after the split of a shared policy, with hidden states and whole replay
    buffers."""
    first, second = (_learner(name, settings, spec, SEEDS) for _ in range(2))
    tracks = [joined(_experience(spec, iteration, settings)) for iteration in (1, 2, 3, 4)]
    _trained(first, tracks[:2])
    second.load_state_dict(reloaded(first.state_dict()))
    if isinstance(first, LearnerWithReplay) and isinstance(second, LearnerWithReplay):
        kept = first.replay_state()
        assert (kept is not None) == (name in ("madqn", "ddpg"))
        if kept is not None:
            assert len(kept["open"]["streams"]) > 0
            second.load_replay_state(kept)
    (expected, metrics), (got, same) = (_trained(learner, tracks[2:], done=2) for learner in (first, second))
    assert_equal(got, expected)
    assert_equal(same, metrics)


@on_policy_case
def test_separate_learners_continue_from_the_state_of_a_learner_that_stacks_seeds(
    name: str, settings: dict[str, Any], spec: EnvSpec
) -> None:
    """The state is that of a run started on a GPU, or of a version that did not separate seeds; one seed has
    many rows, another hardly any."""
    chosen = {**settings, "precision": "float64"}
    config = build(ENTRIES[name].record_for(chosen), chosen, "algo", name)
    stacked = (SplitLearner if "shared_until" in settings else OnPolicyLearner)(config, spec, SEEDS, "cpu")
    apart = ENTRIES[name].learner(config, spec, SEEDS, "cpu")
    tracks = [joined(_experience(spec, iteration, settings)) for iteration in (1, 2, 3)]
    _trained(stacked, tracks[:2])
    apart.load_state_dict(stacked.state_dict())
    (expected, metrics), (got, same) = (_trained(learner, tracks[2:], done=2) for learner in (stacked, apart))
    assert_close(got, expected, rtol=1e-7, atol=1e-9)
    assert_close(same, metrics, rtol=1e-7, atol=1e-9)


def test_tensors_are_not_shared_with_the_state() -> None:
    learner = _learner("ippo", STEPS, DISCRETE, SEEDS)
    before = learner.state_dict()
    kept = tensors(before)
    other = _learner("ippo", STEPS, DISCRETE, SEEDS)
    other.load_state_dict(before)
    other.update(joined(_experience(DISCRETE, 1, STEPS)), 1, 0.0)
    assert_equal(tensors(before), kept)
