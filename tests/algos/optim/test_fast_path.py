"""Compiled training steps against torch's, which other tests check against their definitions."""

import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from covering import pairwise
from torch import Tensor

from headway.contracts import Box, Discrete, EnvSpec, generator
from headway_algos import kernels
from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.grouping import Grouping
from headway_algos.kernels.minibatch_steps import exp
from headway_algos.kernels.perceptron import tanh
from headway_algos.networks.actor import Actor
from headway_algos.networks.network import make_network
from headway_algos.on_policy.critics.critic_inputs import LocalInputs
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.return_regression import ReturnNetworks, ReturnRegression
from headway_algos.on_policy.updates.gradient_update import GradientUpdate, ppo_update
from headway_algos.optim import fast_path
from headway_algos.optim.adam import StackedAdam
from headway_algos.registry import configure

STACK, ROWS, SIZE, ACTIONS = 3, 700, 5, 3
FLOAT, CPU = torch.float32, torch.device("cpu")
SPACES = {"discrete": Discrete(ACTIONS), "box": Box((-3.0,) * ACTIONS, (3.0,) * ACTIONS)}
# More rows than pass through the cache at once, layers that are no multiple of four.
CONFIG = configure(
    "custom", policies="shared", model=ModelConfig(hidden=(7, 12), actor_gain=1.0), epochs=2, minibatches=3,
    kl_coeff=0.4, entropy_coeff=0.05, clip=0.1,
)  # fmt: skip


@pytest.fixture
def by_torch(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Learners made within this context use torch."""
    monkeypatch.setattr(fast_path, "ENABLED", False)
    return monkeypatch


class Case:
    """Policies and critics with training data."""

    def __init__(self, config: AlgoConfig, space: str, masked: bool, seeds: tuple[int, ...]) -> None:
        spec = EnvSpec("toy", ("a",), SIZE, SPACES[space], has_action_mask=masked)
        self.config, self.seeds, self.spec = config, seeds, spec
        self.layout = Layout(Grouping.of("shared", spec), len(seeds), CPU, FLOAT)
        self.actor = Actor(config.model, spec, seeds, 1, FLOAT)
        each = [self._rows(seed, space, masked) for seed in seeds]
        observations, masks, actions, moved = (
            torch.stack([rows[i] for rows in each]) if each[0][i] is not None else None for i in range(4)
        )
        assert observations is not None
        assert actions is not None
        assert moved is not None
        with torch.no_grad():
            log_probs = self.actor(observations, masks).log_prob(actions) + moved
        # Seed 0 has all of its rows, others fewer.
        selected = np.arange(ROWS) < np.array([ROWS - 123 * seed for seed in seeds])[:, None]
        self.rows = PolicyBatch(observations, masks, actions, log_probs, selected)
        self.advantages = torch.stack([torch.as_tensor(rows[4], dtype=FLOAT) for rows in each])

    def _rows(self, seed: int, space: str, masked: bool) -> list[Any]:
        random = np.random.default_rng(seed)
        observations = torch.as_tensor(random.normal(size=(ROWS, SIZE)), dtype=FLOAT)
        masks, forbidden = None, random.integers(ACTIONS, size=ROWS)
        if space == "discrete":
            actions = torch.as_tensor((forbidden + random.integers(1, ACTIONS, size=ROWS)) % ACTIONS)
            if masked:
                masks = torch.as_tensor(np.arange(ACTIONS) != forbidden[:, None])
        else:
            actions = torch.as_tensor(random.normal(size=(ROWS, ACTIONS)), dtype=FLOAT)
        moved = torch.as_tensor(random.normal(scale=0.2, size=ROWS), dtype=FLOAT)
        return [observations, masks, actions, moved, random.normal(size=ROWS)]

    def improve(self) -> tuple[GradientUpdate, dict[str, Tensor]]:
        update = ppo_update(self.actor, self.config, self.layout)
        return update, update.improve(self.rows, self.advantages, [generator(s, "t") for s in self.seeds])

    def fit(self, outputs: int) -> tuple[ReturnRegression, dict[str, Any]]:
        config, layout = self.config, self.layout
        view = LocalInputs(config, self.spec, Grouping.of("shared", self.spec))
        networks = ReturnNetworks(config, view, outputs, self.seeds, layout)
        regression = ReturnRegression(networks, self.seeds)
        returns = np.stack([np.random.default_rng(s).normal(size=(ROWS, 1)) for s in self.seeds], axis=1)
        taken = None
        if outputs > 1:
            taken = torch.stack(
                [torch.from_numpy(np.random.default_rng(s).integers(outputs, size=ROWS)) for s in self.seeds]
            )
        present = self.rows.selected.T[..., None]
        estimate = CriticEstimate(
            returns, returns, returns, present, self.rows.observations, hidden_states=None, taken=taken
        )
        return regression, regression.fit(estimate, 0)


def _state(learned: GradientUpdate | ReturnRegression) -> list[Tensor]:
    optimiser = learned.optimiser
    assert isinstance(optimiser, StackedAdam)
    return [*optimiser.parameters, *optimiser.means.parts]


@pytest.mark.parametrize(
    ("space", "model", "kl_coeff"),
    pairwise(
        [("discrete", False), ("discrete", True), ("box", False)],
        [CONFIG.model, replace(CONFIG.model, activation="relu"), replace(CONFIG.model, hidden=())],
        [0.0, 0.4],
    ),
)
def test_compiled_policy_updates_equal_torch(
    space: tuple[str, bool], kl_coeff: float, model: ModelConfig, by_torch: pytest.MonkeyPatch
) -> None:
    config = replace(CONFIG, kl_coeff=kl_coeff, model=model)
    theirs, their_info = Case(config, *space, (0, 1, 2)).improve()
    by_torch.undo()
    ours, info = Case(config, *space, (0, 1, 2)).improve()
    for mine, its in zip(_state(ours), _state(theirs), strict=True):
        torch.testing.assert_close(mine, its, rtol=2e-4, atol=2e-6)
    assert 0.05 < float(info["clip_fraction"].mean()) < 0.95
    for name, value in their_info.items():
        torch.testing.assert_close(info[name], value, rtol=1e-4, atol=1e-6, msg=name)


@pytest.mark.parametrize("outputs", [1, 4])
@pytest.mark.parametrize("value_clip", [None, 1.0])
def test_compiled_critic_updates_equal_torch(
    outputs: int, value_clip: float | None, by_torch: pytest.MonkeyPatch
) -> None:
    config = replace(CONFIG, value_clip=value_clip)
    theirs, their_info = Case(config, "box", False, (0, 1, 2)).fit(outputs)
    by_torch.undo()
    ours, info = Case(config, "box", False, (0, 1, 2)).fit(outputs)
    for mine, its in zip(_state(ours), _state(theirs), strict=True):
        torch.testing.assert_close(mine, its, rtol=2e-4, atol=2e-6)
    np.testing.assert_allclose(info["loss"], their_info["loss"], rtol=1e-5)


@pytest.mark.parametrize(("space", "masked"), [("discrete", True), ("box", False)])
def test_a_network_trains_bit_for_bit_the_same_in_any_stack(space: str, masked: bool) -> None:
    """Although other networks have more rows, so that it has padding, and batches exceed `piece_samples`.

    One network has no rows. Without a KL penalty, whose outputs torch computes: on some processors these
    round differently in another stack (see `headway_algos.on_policy.per_seed_learner`).
    """
    config, seeds = replace(CONFIG, piece_samples=300, kl_coeff=0.0), (0, 3, 6)
    together, info = Case(config, space, masked, seeds).improve()
    of_values, losses = Case(config, space, masked, seeds).fit(1)
    for place, seed in enumerate(seeds):
        alone, info_alone = Case(config, space, masked, (seed,)).improve()
        values_alone, loss_alone = Case(config, space, masked, (seed,)).fit(1)
        for whole, part in ((together, alone), (of_values, values_alone)):
            pairs = zip(_state(whole), _state(part), strict=True)
            assert all(torch.equal(its[place], mine[0]) for its, mine in pairs)
        np.testing.assert_array_equal(losses["loss"][place], loss_alone["loss"][0])
        np.testing.assert_array_equal(info["entropy"][place], info_alone["entropy"][0])
    assert together.optimiser.counts.tolist() == [6, 6, 0]


def test_part_of_a_stack_trains_as_in_the_whole() -> None:
    """The sequential order trains such parts."""
    whole, _ = Case(CONFIG, "box", False, (0, 1, 2)).improve()
    case, policies = Case(CONFIG, "box", False, (0, 1, 2)), torch.tensor([1])
    update = ppo_update(case.actor, CONFIG, case.layout)
    before = [tensor.clone() for tensor in _state(update)]
    part = update.narrow(policies)
    part.improve(case.rows.narrow(policies), case.advantages[policies], [generator(1, "t")])
    update.adopt(policies, part)
    for mine, its, old in zip(_state(update), _state(whole), before, strict=True):
        assert torch.equal(mine[1], its[1])
        assert torch.equal(mine[[0, 2]], old[[0, 2]])


def test_parameters_given_to_another_optimiser_are_not_learned_by_the_first() -> None:
    case = Case(CONFIG, "box", False, (0, 1))
    update = ppo_update(case.actor, CONFIG, case.layout)
    StackedAdam(case.actor.learnable, 1e-3, None)
    with pytest.raises(RuntimeError, match="given to another optimiser"):
        update.improve(case.rows, case.advantages, [generator(seed, "t") for seed in case.seeds])


_WARMED = """
from headway_algos import kernels
kernels.warm()
for name in ("step_networks", "descend_gaussian", "descend_categorical", "descend_returns"):
    print(name, sorted(map(str, getattr(kernels, name).signatures)))
print("layer", sorted(map(str, kernels.perceptron.layer.signatures)))
"""


def test_training_compiles_nothing_after_warm_up() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _WARMED], check=True, timeout=120, capture_output=True, text=True
    )
    for kl_coeff, value_clip in ((0.0, None), (0.4, 1.0)):
        config = replace(CONFIG, kl_coeff=kl_coeff, value_clip=value_clip)
        for space, masked in (("discrete", False), ("discrete", True), ("box", False)):
            for seeds in ((0,), (0, 1, 2)):
                Case(config, space, masked, seeds).improve()
                for outputs in (1, 4):
                    Case(config, space, masked, seeds).fit(outputs)
    warmed = dict(line.split(" ", 1) for line in done.stdout.splitlines())
    for name in ("descend_gaussian", "descend_categorical", "descend_returns"):
        assert str(sorted(map(str, getattr(kernels, name).signatures))) == warmed[name]
    assert str(sorted(map(str, kernels.perceptron.layer.signatures))) == warmed["layer"]
    of_adam: Any = kernels.step_networks
    assert all(str(signature) in warmed["step_networks"] for signature in of_adam.signatures)


_UNCACHED = """
from headway_algos.kernels.perceptron import tanh
from headway_algos.registry import configure
import numpy as np
row = np.array([0.5], np.float32)
tanh(row, np.float32(0), 1)
assert abs(row[0] - np.tanh(0.5)) < 1e-6
"""


def test_kernels_are_compiled_without_a_writable_cache() -> None:
    nowhere = {**os.environ, "NUMBA_CACHE_LOCATOR_CLASSES": "ZipCacheLocator"}
    subprocess.run([sys.executable, "-c", _UNCACHED], check=True, timeout=120, env=nowhere)


@pytest.mark.parametrize(
    ("model", "dtype", "compiled"),
    [
        (CONFIG.model, FLOAT, True),
        (ModelConfig(hidden=(256, 256)), FLOAT, True),
        (ModelConfig(hidden=(8,), core="gru"), FLOAT, False),
        (CONFIG.model, torch.float64, False),
    ],
)
def test_kernels_are_used_for_every_size_of_perceptron_in_float32(
    model: ModelConfig, dtype: torch.dtype, compiled: bool
) -> None:
    network = make_network(model, (0, 1), 1, "actor", (SIZE, ACTIONS), 1.0, dtype)
    optimiser = StackedAdam(network.parameters(), 1e-3, None)
    assert (fast_path.kernel_networks(network, optimiser) is not None) == compiled


def test_a_nan_parameter_is_kept_and_detected() -> None:
    case = Case(CONFIG, "box", False, (0, 1))
    case.actor.network.weights[0].data[1, 0, 0] = torch.nan
    update, info = case.improve()
    assert torch.isnan(info["gradient_norm"]).tolist() == [False, True]
    assert torch.isfinite(update.optimiser.values.whole[0]).all()


def test_exp_is_accurate_to_a_few_units_in_the_last_place() -> None:
    x = np.concatenate([np.linspace(-86.9, 88, 100_001), np.logspace(-30, 1, 1000)]).astype(np.float32)
    ours, bits = x.copy(), np.empty(len(x), np.int32)
    exp(ours, bits, bits.view(np.float32), len(x))
    assert np.abs(ours / np.exp(x.astype(np.float64)) - 1).max() < 3e-7
    odd = np.array([-np.inf, -1e30, np.inf, np.nan], np.float32)
    exp(odd, bits, bits.view(np.float32), len(odd))
    assert odd[:2].tolist() == [0, 0]
    assert odd[2] > 1e38
    assert np.isnan(odd[3])


def test_tanh_is_accurate_to_a_few_units_in_the_last_place() -> None:
    x = np.concatenate([np.linspace(-12, 12, 100_001), np.logspace(-30, 1, 1000)]).astype(np.float32)
    ours = x.copy()
    tanh(ours, np.float32(0), len(x))
    expected = np.tanh(x.astype(np.float64))
    assert np.abs(ours - expected).max() < 5e-7
    assert (np.abs(ours / np.where(x == 0, 1, expected) - 1)[x != 0] < 1e-6).all()
    assert np.abs(ours).max() == 1
    odd = np.array([np.nan, np.inf, -np.inf, 1e-20], np.float32)
    tanh(odd, np.float32(0), 4)
    np.testing.assert_allclose(odd, [np.nan, 1, -1, 1e-20], rtol=5e-7)
