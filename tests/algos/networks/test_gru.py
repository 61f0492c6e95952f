"""Recurrent networks against torch's units and against loops over agents."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from made_trajectories import DISCRETE, TEAM, fabricate
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, HeadwayError, Trajectory
from headway.rollout.plan import RolloutPlan
from headway.rollout.serial_collector import SerialCollector
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.whole_batch import WholeBatch
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.networks.actor import Actor
from headway_algos.networks.gru import RecurrentNetwork
from headway_algos.networks.network import make_network
from headway_algos.networks.timeline import Timeline
from headway_algos.on_policy.critics.value import ValueCritic
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.on_policy.updates.trpo import TRPO
from headway_algos.optim.fisher import double_backward, from_vector
from headway_algos.registry import ENTRIES, configure
from headway_envs.toy.visitors import Visitors, VisitorsConfig

UNITS, LENGTH = 5, 3
GRU = ModelConfig(hidden=(6,), core="gru", gru_size=UNITS, sequence_length=LENGTH, actor_gain=1.0)
SETTINGS: dict[str, Any] = {
    "policies": "independent",
    "model": GRU, "precision": "float64", "lr": 3e-3, "minibatches": 2, "epochs": 2, "grad_clip": None,
}  # fmt: skip


def named(name: str, **settings: Any) -> Any:  # noqa: ANN401 - any record
    return configure(name, **{**SETTINGS, **settings})


def randomised(network: RecurrentNetwork, seed: int = 0) -> RecurrentNetwork:
    """Set nonzero biases."""
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for bias in (*network.biases, network.bias_input, network.bias_memory):
            bias.normal_(generator=random)
    return network


class Alone:
    """Network p of a stack as torch modules: one row, one step."""

    def __init__(self, network: RecurrentNetwork, p: int) -> None:
        self.layers = [(w[p], b[p, :, 0]) for w, b in zip(network.weights, network.biases, strict=True)]
        self.cell = torch.nn.GRUCell(network.weight_input.shape[2], UNITS, dtype=torch.float64)
        silent = torch.zeros(2 * UNITS, dtype=torch.float64)
        units = {
            "weight_ih": network.weight_input[p],
            "weight_hh": network.weight_memory[p],
            "bias_ih": network.bias_input[p, :, 0],
            "bias_hh": torch.cat([silent, network.bias_memory[p, :, 0]]),
        }
        for name, tensor in units.items():
            delattr(self.cell, name)
            setattr(self.cell, name, tensor.double())

    def step(self, row: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs and the hidden state after one row."""
        for weight, bias in self.layers[:-1]:
            row = torch.tanh(weight.double() @ row + bias.double())
        hidden = self.cell(row[None], hidden[None])[0]
        weight, bias = self.layers[-1]
        return weight.double() @ hidden + bias.double(), hidden


def test_gated_units_equal_torch() -> None:
    """Two networks, four sequences of six steps, one after another in torch.nn.GRU."""
    network = randomised(make_network(replace(GRU, hidden=()), (1, 2), 1, "x", (3, 2), 1.0, torch.float64))  # type: ignore[arg-type]  # it remembers
    rows, start = torch.randn(2, 4, 6, 3, dtype=torch.float64), torch.randn(2, 4, UNITS, dtype=torch.float64)
    got = network.hidden_states(rows.transpose(1, 2).flatten(1, 2), Timeline(start.transpose(1, 2)))
    for p in range(2):
        alone = Alone(network, p).cell
        reference = torch.nn.GRU(3, UNITS, batch_first=True, dtype=torch.float64)
        names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        reference.load_state_dict({f"{name}_l0": getattr(alone, name).detach() for name in names})
        expected, _ = reference(rows[p], start[p][None])
        torch.testing.assert_close(got[p].view(UNITS, 6, 4).permute(2, 1, 0), expected, rtol=0, atol=1e-12)


def test_a_recurrent_network_without_a_timeline_is_refused() -> None:
    network = make_network(GRU, (1,), 1, "x", (3, 2), 1.0, torch.float64)
    with pytest.raises(HeadwayError, match=r"order of rows in time.*use algo\.model\.core=none$"):
        network(torch.zeros(1, 2, 3, dtype=torch.float64))


def _plan(policies: str, precision: str, seeds: tuple[int, ...]) -> tuple[AlgoConfig, RolloutPlan]:
    prepared = VisitorsConfig(agents=3, steps=9)
    spec = replace(Visitors(prepared, 1).spec, groups=tuple("xyx"))
    config = named("ippo", policies=policies, precision=precision)
    policy = ENTRIES["ippo"].acting_policy(config, spec)
    return config, RolloutPlan(Visitors, (), prepared, spec, policy, seeds, 4, 20, 2)


@pytest.mark.parametrize(
    ("policies", "precision"), [("independent", "float64"), ("shared", "float32"), ("groups", "float64")]
)
def test_hidden_states_of_workers_equal_torch_along_whole_trajectories(policies: str, precision: str) -> None:
    """Every log-probability, by agent and step, over several iterations, with agents that come, go and retire
    and episodes of different lengths."""
    config, plan = _plan(policies, precision, (3, 5))
    learner = OnPolicyLearner(config, plan.spec, plan.seeds, "cpu")
    network = learner.actor.network
    assert isinstance(network, RecurrentNetwork)
    randomised(network)
    collector = SerialCollector(plan)
    collector.begin()
    hidden = torch.zeros(8, 3, UNITS, dtype=torch.float64)
    tolerance = 1e-5 if precision == "float32" else 1e-11
    alone = [Alone(network, p) for p in range(len(network.bias_input))]
    each = learner.grouping.num_policies
    followed = {int(n): k for k, members in enumerate(learner.grouping.members) for n in members}
    for iteration in (1, 2):
        collector.collect(iteration, learner.acting_parameters())
        track = collector.trajectory
        np.testing.assert_allclose(track.hidden_states[0], hidden, atol=tolerance)
        assert not hidden[torch.from_numpy(track.begins[0])].any()
        assert track.begins.all() == (iteration == 1)
        for t, c, n in np.argwhere(np.ones_like(track.terminated)):
            if track.alive[t, c, n]:
                row = torch.tensor(track.observations[t, c, n], dtype=torch.float64)
                mask = torch.tensor(track.action_masks[t, c, n])
                with torch.no_grad():
                    row = row / np.sqrt(1 + 1e-8)  # the normaliser has seen nothing yet
                    which = alone[c // 4 * each + followed[int(n)]]
                    logits, hidden[c, n] = which.step(row, hidden[c, n])
                logits = torch.where(mask, logits, -torch.inf)
                expected = torch.log_softmax(logits, 0)[track.actions[t, c, n]].item()
                assert track.log_probs[t, c, n] == pytest.approx(expected, abs=tolerance)
            if track.terminated[t, c, n] or track.truncated[t, c, n]:
                hidden[c, n] = 0
    assert not (hidden == 0).all()
    collector.close()


def made(spec: EnvSpec, seed: int, steps: int = 8, **chances: float) -> Trajectory:
    """A trajectory of three copies in which some agents start with nonzero hidden states."""
    return fabricate(spec, steps, 3, seed, hidden_size=UNITS, **{"ends": 0.15, "leaves": 0.05, **chances})


def naive_hidden_states(
    network: RecurrentNetwork, inputs: NDArray[Any], track: Trajectory, follows: Callable[[int], int]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Hidden states before (T + 1, C, N, M) and after (T, C, N, M) each step, for inputs (T, C, N, D)."""
    steps, copies, agents = track.terminated.shape
    before, after = np.zeros((steps + 1, copies, agents, UNITS)), np.zeros((steps, copies, agents, UNITS))
    for c in range(copies):
        for n in range(agents):
            alone, hidden = Alone(network, follows(n)), torch.tensor(track.hidden_states[0, c, n])
            for t in range(steps):
                before[t, c, n] = hidden
                if track.alive[t, c, n]:
                    with torch.no_grad():
                        hidden = alone.step(torch.tensor(inputs[t, c, n], dtype=torch.float64), hidden)[1]
                after[t, c, n] = hidden
                if track.terminated[t, c, n] or track.truncated[t, c, n]:
                    hidden = torch.zeros_like(hidden)
            before[steps, c, n] = hidden
    return before, after


@pytest.mark.parametrize("policies", ["independent", "shared", "groups"])
def test_replayed_hidden_states_equal_a_loop_over_agents(policies: str) -> None:
    config = named("ippo", policies=policies, normalise_observations=False, piece_samples=40)
    learner, track = OnPolicyLearner(config, DISCRETE, (0,), "cpu"), made(DISCRETE, 1, absent=0.3)
    network = learner.actor.network
    assert isinstance(network, RecurrentNetwork)
    hidden_states = learner._hidden_states(track, learner._observations(track, learner.actor))
    assert isinstance(hidden_states, HiddenStates)
    groups = {n: k for k, members in enumerate(learner.grouping.members) for n in members.tolist()}
    before, after = naive_hidden_states(network, track.observations, track, lambda n: groups[n])
    np.testing.assert_allclose(hidden_states.before, before, atol=1e-12)
    np.testing.assert_allclose(hidden_states.after, after, atol=1e-12)


def naive_surrogate(actor: Actor, track: Trajectory, advantages: NDArray[Any], coeff: float) -> list[Tensor]:
    """E[pi / pi_old A] + coeff E[H] of independent policies, with gradients back to the last multiple of
    LENGTH steps, or to the beginning of the stream."""
    network, found = actor.network, []
    assert isinstance(network, RecurrentNetwork)
    steps, copies, agents = track.terminated.shape
    for n in range(agents):
        alone, total, rows = Alone(network, n), torch.zeros((), dtype=torch.float64), 0
        for c in range(copies):
            hidden = torch.tensor(track.hidden_states[0, c, n])
            for t in range(steps):
                hidden = hidden.detach() if t % LENGTH == 0 else hidden
                if track.alive[t, c, n]:
                    row = torch.tensor(track.observations[t, c, n], dtype=torch.float64)
                    logits, hidden = alone.step(row, hidden)
                    if track.acting[t, c, n]:
                        allowed = torch.tensor(track.action_masks[t, c, n])
                        log_probs = torch.log_softmax(logits[allowed], 0)
                        place = int(track.action_masks[t, c, n, : track.actions[t, c, n]].sum())
                        ratio = (log_probs[place] - track.log_probs[t, c, n]).exp()
                        entropy = -(log_probs.exp() * log_probs).sum()
                        total, rows = total + ratio * advantages[t, c, n] + coeff * entropy, rows + 1
                if track.terminated[t, c, n] or track.truncated[t, c, n]:
                    hidden = torch.zeros_like(hidden)
        found.append(total / max(rows, 1))
    return found


@pytest.mark.parametrize("piece_samples", [10, 5120])
def test_gradients_through_sequences_equal_a_loop(piece_samples: int) -> None:
    """T = 8 in sequences of 3: the last is filled up. Streams end, and agents are away, in their midst."""
    config = named("itrpo", normalise_observations=False, piece_samples=piece_samples)
    learner, track = OnPolicyLearner(config, DISCRETE, (0,), "cpu"), made(DISCRETE, 2, absent=0.3, idle=0.3)
    randomised(learner.actor.network)  # type: ignore[arg-type]  # it remembers
    advantages = np.random.default_rng(0).standard_normal(track.rewards.shape)
    batch = WholeBatch.of(*rows_of(learner, track, advantages))
    assert isinstance(learner.policy_update, TRPO)
    gradient, surrogate, *_ = learner.policy_update._gradient(batch)
    expected = naive_surrogate(learner.actor, track, advantages, config.entropy_coeff)
    torch.testing.assert_close(surrogate, torch.stack(expected).detach(), rtol=0, atol=1e-12)
    parameters = learner.actor.learnable
    slopes = torch.autograd.grad(sum(expected[1:], expected[0]), parameters)
    for got, slope in zip(from_vector(gradient, parameters), slopes, strict=True):
        torch.testing.assert_close(got, slope, rtol=0, atol=1e-11)


def rows_of(
    learner: OnPolicyLearner, track: Trajectory, advantages: NDArray[Any]
) -> tuple[PolicyBatch, Tensor]:
    """Return what the policy update is given."""
    observations = learner._observations(track, learner.actor)
    rows = learner._policy_batch(track, observations, learner._hidden_states(track, observations))
    return rows, learner.layout.rows(np.broadcast_to(advantages, track.rewards.shape))


def test_fisher_products_backpropagate_through_time() -> None:
    """Against the Hessian of the mean KL of one small policy, entry by entry."""
    model = replace(GRU, hidden=(), gru_size=2)
    config = named("itrpo", model=model, normalise_observations=False)
    spec = replace(DISCRETE, agents=("a",), groups=("x",), observation_size=2, has_action_mask=False)
    learner = OnPolicyLearner(config, spec, (0,), "cpu")
    track = fabricate(spec, 7, 2, 4, hidden_size=2, absent=0.2, ends=0.2)
    batch = WholeBatch.of(*rows_of(learner, track, np.zeros(track.rewards.shape)))
    actor, parameters = learner.actor, learner.actor.learnable
    shapes = [p.shape for p in parameters]
    old = actor(batch.observations, None, batch.timeline).detach()

    def mean_kl(vector: Tensor) -> Tensor:
        parts = torch.split(vector, [shape.numel() for shape in shapes])
        names = [name for name, _ in actor.named_parameters()]
        state = {name: part.view(shape) for name, part, shape in zip(names, parts, shapes, strict=True)}
        new = torch.func.functional_call(actor, state, (batch.observations, None, batch.timeline))
        return (new.kl_from(old) * batch.weight).sum()

    here = torch.cat([p.detach().flatten() for p in parameters])
    hessian = torch.autograd.functional.hessian(mean_kl, here)
    product = double_backward(actor, batch, 10)
    for i in range(0, len(here), 5):
        unit = torch.zeros(1, len(here), dtype=torch.float64)
        unit[0, i] = 1
        torch.testing.assert_close(product(unit)[0], hessian[i], rtol=0, atol=1e-10)


def test_hidden_states_of_critics_continue_across_iterations() -> None:
    """Values of a local critic against a loop; the second trajectory continues from the first one's hidden
    states, and final values of truncated streams use the hidden state at the truncation."""
    config = named("ippo", normalise_observations=False, normalise_values=False, lr=1e-9, gae_lambda=0.0)
    learner = OnPolicyLearner(config, DISCRETE, (0,), "cpu")
    critic = learner.critic
    assert isinstance(critic, ValueCritic)
    network = critic.networks.network
    assert isinstance(network, RecurrentNetwork)
    carried = np.zeros((3, 4, UNITS))
    for iteration in (1, 2):
        track = made(DISCRETE, 5 + iteration, absent=0.2)
        track.begins[:] = np.random.default_rng(iteration).random(track.begins.shape) < 0.5
        track.hidden_states[0] = np.where(track.begins[0][..., None], 0, carried)
        before, after = naive_hidden_states(network, track.observations, track, lambda n: n)
        estimate = critic.estimate(track, learner.behaviour, iteration)
        for t, c, n in np.argwhere(track.alive[:-1]):
            alone = Alone(network, int(n))

            def value(row: NDArray[Any], hidden: NDArray[Any], alone: Alone = alone) -> float:
                seen = torch.tensor(row, dtype=torch.float64)
                return alone.step(seen, torch.tensor(hidden))[0].item()

            here = value(track.observations[t, c, n], before[t, c, n])
            assert estimate.values[t, c, n] == pytest.approx(here, abs=1e-12)
            ended, cut = track.terminated[t, c, n], track.truncated[t, c, n]
            if cut and not ended:
                ahead = value(track.final_observations[t, c, n], after[t, c, n])
            elif not ended and track.alive[t + 1, c, n]:
                ahead = value(track.observations[t + 1, c, n], before[t + 1, c, n])
            elif ended:
                ahead = 0.0
            else:
                continue
            expected = float(track.rewards[t, c, n]) + config.gamma * ahead - here
            assert estimate.advantages[t, c, n] == pytest.approx(expected, abs=1e-9)
        critic.fit(estimate, iteration)
        carried = before[-1]
        assert critic.networks.carried is not None
        np.testing.assert_allclose(critic.networks.carried, carried, atol=1e-12)


@pytest.mark.parametrize("ended", [False, True])
def test_a_team_s_critic_remembers_until_the_episode_ends(ended: bool) -> None:
    """All slots are freed with the last step of an iteration, as happens if there are few. Two iterations
    have the values of one that is as long as both."""
    config = named("mappo", normalise_observations=False, normalise_values=False, lr=1e-9)
    parts = [fabricate(TEAM, 6, 3, seed, ends=0.0, leaves=0.2, hidden_size=UNITS) for seed in (1, 2)]
    for part in parts:
        part.terminated[-1], part.episode_ended[-1] = True, ended
    parts[0].begins[:], parts[0].episode_begins[:] = True, True
    parts[1].begins[:], parts[1].episode_begins[:] = True, ended
    arrays = []
    for field in fields(Trajectory):
        first, second = (getattr(part, field.name) for part in parts)
        if len(first) > 6:  # the last row is the first of the second iteration
            first[-1] = second[0]
        arrays.append(first if len(first) == 1 else np.concatenate([first[:6], second]))
    whole = OnPolicyLearner(config, TEAM, (0,), "cpu")
    expected = whole.critic.estimate(Trajectory(*arrays), whole.behaviour, 1).values
    learner, values = OnPolicyLearner(config, TEAM, (0,), "cpu"), []
    for iteration, part in enumerate(parts, 1):
        estimate = learner.critic.estimate(part, learner.behaviour, iteration)
        learner.critic.fit(estimate, iteration)
        values.append(estimate.values)
    np.testing.assert_allclose(np.concatenate(values), expected, atol=1e-6)
