"""Targets, losses and target networks against their definitions, in float64."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from headway.contracts import Box, Discrete, EnvSpec
from headway_algos.networks.mlp import StackedMLP
from headway_algos.off_policy.ddpg import DeterministicPolicyGradient
from headway_algos.off_policy.dqn import QLearning
from headway_algos.off_policy.replay_buffer import Batch
from headway_algos.off_policy.target_networks import TargetNetwork, mean_over_batch, regression_loss
from headway_algos.replay_config import DDPGConfig, MADQNConfig, NetworkConfig

DOUBLE = torch.float64
CPU = torch.device("cpu")
SEEDS, K, B, D, A = (1, 2), 2, 5, 3, 4
P = len(SEEDS) * K
DISCRETE = EnvSpec("made", ("a", "b"), D, Discrete(A), has_action_mask=True)
BOX = EnvSpec("made", ("a", "b"), D, Box((-2.0, 0.0), (2.0, 1.0)))
MADQN = MADQNConfig(model=NetworkConfig((6,), "tanh"), precision="float64", grad_clip=None)
DDPG = DDPGConfig(model=NetworkConfig((6,), "tanh"), precision="float64", grad_clip=None)
ALL = np.ones(P, np.bool_)


def _batch(spec: EnvSpec) -> Batch:
    random = torch.Generator().manual_seed(4)
    masks = None
    if spec.has_action_mask:
        masks = torch.rand(P, B, A, generator=random) < 0.5
        masks[..., 1] |= ~masks.any(-1)
        actions = torch.randint(0, A, (P, B), generator=random)
    else:
        low, high = torch.tensor([-2.0, 0.0], dtype=DOUBLE), torch.tensor([2.0, 1.0], dtype=DOUBLE)
        actions = low + (high - low) * torch.rand(P, B, 2, generator=random, dtype=DOUBLE)
    discounts = torch.rand(P, B, generator=random, dtype=DOUBLE)
    discounts[:, 0] = 0
    return Batch(
        torch.randn(P, B, D, generator=random, dtype=DOUBLE),
        actions,
        torch.randn(P, B, generator=random, dtype=DOUBLE),
        discounts,
        torch.randn(P, B, D, generator=random, dtype=DOUBLE),
        masks,
    )


def _randomise_target(target: TargetNetwork) -> None:
    """Move a target network far from its online network."""
    random = torch.Generator().manual_seed(8)
    for parameter in target.network.parameters():
        parameter += torch.randn(parameter.shape, generator=random, dtype=DOUBLE)


def _by_hand(network: StackedMLP, p: int, x: Tensor) -> Tensor:
    """Outputs of one network for one row of inputs."""
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        x = weight[p] @ x + bias[p, :, 0]
        if i < len(network.weights) - 1:
            x = x.tanh()
    return x


@pytest.mark.parametrize("double", [True, False])
def test_q_targets_are_those_of_a_loop(double: bool) -> None:
    method, batch = QLearning(replace(MADQN, double=double), DISCRETE, SEEDS, K, CPU), _batch(DISCRETE)
    _randomise_target(method.target)
    targets = method.targets(batch)
    assert batch.next_masks is not None
    differ = 0
    for p in range(P):
        for b in range(B):
            online = _by_hand(method.network, p, batch.next_observations[p, b]).detach()
            judged = _by_hand(method.target.network, p, batch.next_observations[p, b]).detach()
            allowed = [u for u in range(A) if batch.next_masks[p, b, u]]
            best = max(allowed, key=lambda u: float((online if double else judged)[u]))
            expected = batch.returns[p, b] + batch.discounts[p, b] * judged[best]
            np.testing.assert_allclose(targets[p, b], expected, rtol=1e-12)
            differ += int(best != int(online.argmax())) + int(best != int(judged.argmax()))
    assert differ > 0  # the masks, and who chooses, matter here
    assert torch.equal(targets[:, 0], batch.returns[:, 0])


def _assert_descends(
    method: QLearning | DeterministicPolicyGradient, batch: Batch, losses: list[Tensor]
) -> None:
    """Each policy takes Adam's first step on its loss: the gradient over its absolute value."""
    parameters = list(method.network.parameters())
    before = [parameter.detach().clone() for parameter in parameters]
    gradients = torch.autograd.grad(torch.stack(losses).sum(), parameters)
    method.learn(batch, ALL)
    for old, parameter, gradient in zip(before, parameters, gradients, strict=True):
        expected = old - method.config.lr * gradient / (gradient.abs() + 1e-5)
        np.testing.assert_allclose(parameter.detach(), expected, rtol=1e-9, atol=1e-12)


def test_a_step_of_q_learning_is_adam_s_on_the_mean_loss_of_the_actions_taken() -> None:
    config = replace(MADQN, loss="squared", target_every=1000)
    method, batch = QLearning(config, DISCRETE, SEEDS, K, CPU), _batch(DISCRETE)
    _randomise_target(method.target)
    targets = method.targets(batch)
    losses = []
    for p in range(P):
        loss = torch.zeros((), dtype=DOUBLE)
        for b in range(B):
            value = _by_hand(method.network, p, batch.observations[p, b])[batch.actions[p, b]]
            loss = loss + 0.5 * (value - targets[p, b]) ** 2 / B
        losses.append(loss)
    _assert_descends(method, batch, losses)


def test_deterministic_targets_are_those_of_a_loop() -> None:
    method, batch = DeterministicPolicyGradient(DDPG, BOX, SEEDS, K, CPU), _batch(BOX)
    _randomise_target(method.target_actor)
    _randomise_target(method.target_critic)
    targets = method.targets(batch)
    for p in range(P):
        for b in range(B):
            then = batch.next_observations[p, b]
            action = _by_hand(method.target_actor.network, p, then).tanh()
            value = _by_hand(method.target_critic.network, p, torch.cat([then, action]))[0]
            expected = batch.returns[p, b] + batch.discounts[p, b] * value
            np.testing.assert_allclose(targets[p, b], expected, rtol=1e-12)


@pytest.mark.parametrize("saturation_coeff", [0.0, 0.7])
def test_actors_ascend_the_critic_along_their_own_action(saturation_coeff: float) -> None:
    """The step is Adam's on the gradient of the mean of Q(o, mu(o)) with a fixed critic, minus the weighted
    squares of the inputs of tanh."""
    config = replace(DDPG, critic_lr=1e-30, tau=1.0, target_every=1000, saturation_coeff=saturation_coeff)
    method, batch = DeterministicPolicyGradient(config, BOX, SEEDS, K, CPU), _batch(BOX)
    losses = []
    for p in range(P):
        gain = torch.zeros((), dtype=DOUBLE)
        for b in range(B):
            now = batch.observations[p, b]
            output = _by_hand(method.network, p, now)
            gain = gain + _by_hand(method.critic, p, torch.cat([now, output.tanh()]))[0] / B
            gain = gain - saturation_coeff * (output**2).sum() / B
        losses.append(-gain)
    _assert_descends(method, batch, losses)


def test_critics_see_actions_in_units_of_the_bounds() -> None:
    """Moving the bounds and the actions with them changes no loss."""
    batch = _batch(BOX)
    wide = replace(BOX, action_space=Box((-20.0, 5.0), (20.0, 15.0)))
    scaled = replace(batch, actions=torch.tensor([0.0, 5.0]) + batch.actions * 10)
    losses = [
        DeterministicPolicyGradient(DDPG, spec, SEEDS, K, CPU).learn(given, ALL)["critic/loss"]
        for spec, given in ((BOX, batch), (wide, scaled))
    ]
    np.testing.assert_allclose(losses[0], losses[1], rtol=1e-9)


@pytest.mark.parametrize("error", [-3.0, -1.0, -0.2, 0.0, 0.7, 1.0, 4.0])
def test_losses_by_definition(error: float) -> None:
    given = torch.tensor(error, dtype=DOUBLE)
    huber = 0.5 * error**2 if abs(error) <= 1 else abs(error) - 0.5
    assert float(regression_loss(given, "huber")) == pytest.approx(huber, abs=1e-15)
    assert float(regression_loss(given, "squared")) == pytest.approx(0.5 * error**2, abs=1e-15)


def _updated_targets(
    tau: float, every: int, active: list[list[bool]]
) -> tuple[list[Any], list[Any], list[Any]]:
    """Initial, online and target weights of two networks, of which those `active` took steps."""
    online = StackedMLP((1, 2), 1, "q network", (2, (), 1), "tanh", 1.0, DOUBLE)
    target = TargetNetwork(online, every, tau)
    first = online.weights[0].detach().clone()
    with torch.no_grad():
        online.weights[0] += 1
    counts = np.zeros(2, np.int64)
    for step in active:
        counts += np.array(step)
        target.follow(np.array(step), counts)
    return first, online.weights[0].detach(), target.network.weights[0]  # type: ignore[return-value]  # tensors


def test_hard_targets_are_copied_at_a_fixed_number_of_steps_per_network() -> None:
    first, online, target = _updated_targets(1.0, 3, [[True, False], [True, True]])
    assert torch.equal(target, first)  # type: ignore[arg-type]
    _, online, target = _updated_targets(1.0, 3, [[True, False], [True, True], [True, True]])
    assert torch.equal(target[0], online[0])
    assert torch.equal(target[1], first[1])


@pytest.mark.parametrize("tau", [0.01, 0.3])
def test_soft_targets_move_by_tau(tau: float) -> None:
    """theta' <- tau theta + (1 - tau) theta', n times: (1 - tau)^n of the distance is left."""
    first, online, target = _updated_targets(tau, 1, [[True, True]] * 4 + [[True, False]] * 3)
    for network, steps in ((0, 7), (1, 4)):
        expected = online[network] + (first[network] - online[network]) * (1 - tau) ** steps
        np.testing.assert_allclose(target[network], expected, rtol=1e-12)


@pytest.mark.parametrize("kind", ["madqn", "ddpg"])
def test_networks_without_a_batch_stay_unchanged(kind: str) -> None:
    make: Callable[[], Any] = {
        "madqn": lambda: QLearning(replace(MADQN, target_every=1), DISCRETE, SEEDS, K, CPU),
        "ddpg": lambda: DeterministicPolicyGradient(DDPG, BOX, SEEDS, K, CPU),
    }[kind]
    batch = _batch(DISCRETE if kind == "madqn" else BOX)
    method, untouched = make(), make()
    active = np.array([True, False, True, False])
    for _ in range(2):
        method.learn(batch, active)
    pairs = [(method.network, untouched.network)]
    if kind == "madqn":
        pairs += [(method.target.network, untouched.target.network)]
    else:
        pairs += [(method.critic, untouched.critic)]
        pairs += [(method.target_actor.network, untouched.target_actor.network)]
        pairs += [(method.target_critic.network, untouched.target_critic.network)]
    for module, before in pairs:
        for now, then in zip(module.parameters(), before.parameters(), strict=True):
            assert torch.equal(now[~torch.from_numpy(active)], then[~torch.from_numpy(active)])
            assert not torch.equal(now[0], then[0])


def test_means_leave_out_networks_without_a_batch() -> None:
    losses = torch.arange(6.0).reshape(2, 3).requires_grad_()
    means = mean_over_batch(losses, np.array([True, False]))
    assert means.tolist() == [1.0, 0.0]
    means.sum().backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
    assert losses.grad is not None
    np.testing.assert_allclose(losses.grad, [[1 / 3] * 3, [0.0] * 3])


def _without(
    method: DeterministicPolicyGradient, spec: EnvSpec, dimension: int
) -> DeterministicPolicyGradient:
    """Return the same networks for actions without that dimension."""
    other = DeterministicPolicyGradient(method.config, spec, SEEDS, K, CPU)
    keep = [i for i in range(spec.observation_size + 3) if i != spec.observation_size + dimension]
    options = [i for i in range(3) if i != dimension]
    for mine, theirs in (
        (other.network, method.network), (other.target_actor.network, method.target_actor.network)
    ):  # fmt: skip
        for to, source in zip(mine.parameters(), theirs.parameters(), strict=True):
            to.data.copy_(source.data if to.shape == source.shape else source.data[:, options])
    for mine, theirs in (
        (other.critic, method.critic), (other.target_critic.network, method.target_critic.network)
    ):  # fmt: skip
        for to, source in zip(mine.parameters(), theirs.parameters(), strict=True):
            to.data.copy_(source.data if to.shape == source.shape else source.data[:, :, keep])
    return other


@pytest.mark.parametrize("value", [0.5, 1e6 + 0.1])
def test_a_dimension_whose_bounds_are_equal_changes_nothing(value: float) -> None:
    """All else is learned as without it, also where the value is rounded in an action's float32."""
    wide = replace(BOX, action_space=Box((-2.0, value, 0.0), (2.0, value, 1.0)))
    method, narrow_batch = DeterministicPolicyGradient(DDPG, wide, SEEDS, K, CPU), _batch(BOX)
    _randomise_target(method.target_actor)
    _randomise_target(method.target_critic)
    narrow = _without(method, BOX, 1)
    fixed = torch.full((P, B, 1), value, dtype=torch.float32).to(DOUBLE)
    actions = torch.cat([narrow_batch.actions[..., :1], fixed, narrow_batch.actions[..., 1:]], dim=2)
    for _ in range(3):
        got = method.learn(replace(narrow_batch, actions=actions), ALL)
        expected = narrow.learn(narrow_batch, ALL)
        for name in ("critic/loss", "critic/value", "policy/gradient_norm"):
            torch.testing.assert_close(got[name], expected[name], rtol=1e-9, atol=1e-9)
    again = _without(method, BOX, 1)
    for mine, theirs in ((again.network, narrow.network), (again.critic, narrow.critic)):
        for got_one, expected_one in zip(mine.parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(got_one, expected_one, rtol=1e-9, atol=1e-9)
