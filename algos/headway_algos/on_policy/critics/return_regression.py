"""Value networks and their regression on returns, common to all critics."""

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway.contracts import EnvSpec, Trajectory, generator
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import Layout, mean_per_replica
from headway_algos.batches.minibatches import Piece, even_slices
from headway_algos.batches.schedule import MinibatchSchedule
from headway_algos.components import component
from headway_algos.grouping import Grouping
from headway_algos.networks.gru import RecurrentNetwork
from headway_algos.networks.network import make_network
from headway_algos.networks.normalisation import RunningStatistics
from headway_algos.networks.timeline import Timeline
from headway_algos.on_policy.critics.config import CriticConfig, KFACCriticConfig
from headway_algos.on_policy.critics.critic_inputs import CriticInputs
from headway_algos.on_policy.critics.critic_kernels import compiled_critic_steps
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.reward_streams import presence, stream_begins
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.config import AdamConfig
from headway_algos.optim.gradient_steps import autograd_steps
from headway_algos.optim.kfac_regression import KFACRegression

RETURN_MEMORY, RETURN_BATCHES, RETURN_SHARE = 1000.0, 5.0, 0.1
"""Maximum total weight of all earlier batches in the statistics that normalise returns: the largest of a
number of rows, a multiple of the new batch's rows, and a share of all rows so far.

Returns change as policies learn. With equal weights, large early returns would dominate the scale for the
rest of training; if only the last batch counted, the values learned so far would change with its scale, and
with the time of day where a batch is a short part of an episode."""


class ReturnNetworks(nn.Module):
    """P value networks, with running statistics of their inputs and of returns."""

    def __init__(
        self,
        config: CriticConfig,
        critic_inputs: CriticInputs,
        outputs: int,
        seeds: Sequence[int],
        layout: Layout,
        purpose: str = "critic",
    ) -> None:
        """`purpose`: that of the random streams of initialisation and shuffling."""
        super().__init__()
        self.config, self.critic_inputs, self.layout, self.purpose = config, critic_inputs, layout, purpose
        networks, model = critic_inputs.grouping.num_policies, config.model
        sizes = (critic_inputs.feature_size + critic_inputs.indicator_size, outputs)
        self.network = make_network(model, seeds, networks, purpose, sizes, 1.0, layout.dtype)
        self.carried: NDArray[Any] | None = None
        """(C, W, M), W viewpoints: hidden states of recurrent networks after the last trajectory."""
        self.input_moments = RunningStatistics(len(seeds) * networks, critic_inputs.feature_size)
        self.return_moments = RunningStatistics(
            len(seeds) * networks, 1, RETURN_MEMORY, RETURN_BATCHES, RETURN_SHARE
        )
        self.to(layout.device)

    def rows(self, batch: CriticBatch) -> tuple[Tensor, Tensor | None]:
        """Return features before normalisation (P, B, feature_size) and indicators (P, B, indicator_size)."""
        indicators = self.critic_inputs.indicators(batch)
        indicator_rows = None if indicators is None else self.layout.rows(indicators)
        return self.layout.rows(self.critic_inputs.features(batch)), indicator_rows

    def inputs(self, features: Tensor, indicators: Tensor | None) -> Tensor:
        """Return network inputs (P, B, input_size): normalised features, then indicators unchanged.

        Features are (P, B, feature_size), indicators (P, B, indicator_size).
        """
        if self.config.normalise_observations:
            features = self.input_moments.normalised(features)
        return features if indicators is None else torch.cat([features, indicators], dim=2)

    def predict(self, inputs: Tensor, batch: CriticBatch, hidden_states: HiddenStates | None) -> Tensor:
        """Return outputs (P, O, B) in units of return, float64, for a batch's inputs (P, B, input_size).

        `hidden_states`: result of `replay`. Computed in pieces that fit the cache.
        """
        hidden = None if hidden_states is None else self.layout.rows(batch.select_hidden(hidden_states))
        pieces = even_slices(inputs.shape[1], len(inputs), self.config.piece_samples)
        with torch.no_grad():
            parts = [
                self.network(inputs[:, piece], None if hidden is None else Timeline.of_rows(hidden[:, piece]))
                for piece in pieces
            ]
            outputs = torch.cat(parts, dim=2).double()
        if self.config.normalise_values:
            outputs = outputs * self.return_moments.std + self.return_moments.mean
        return outputs

    def replay(self, inputs: Tensor, trajectory: Trajectory) -> HiddenStates | None:
        """Return the hidden states along a trajectory, continued from the last one; None if not recurrent.

        `inputs` (P, B, input_size) are the network inputs at its steps.
        """
        if not isinstance(self.network, RecurrentNetwork):
            return None
        keeps = presence(trajectory.alive[:-1], self.critic_inputs)
        start = self.carried
        if start is None:
            start = np.zeros((*keeps.shape[1:], self.config.model.gru_size))
        begins, samples = stream_begins(trajectory, self.critic_inputs), self.config.piece_samples
        return HiddenStates.replay(self.network, inputs, start, begins, keeps, self.layout, samples)

    def carry(self, hidden_states: HiddenStates | None) -> None:
        """Store the hidden states at the end of this trajectory, from which the next one continues."""
        if hidden_states is not None:
            self.carried = hidden_states.after_last_step[0]

    def carried_state(self) -> Tensor | None:
        """Return the stored hidden states, for a checkpoint."""
        return None if self.carried is None else torch.from_numpy(self.carried)

    def load_carried(self, state: Tensor | None) -> None:
        """Restore the result of `carried_state`."""
        self.carried = None if state is None else state.cpu().numpy().copy()


class ReturnRegression:
    """Regression of stacked value networks on returns, by minibatches."""

    def __init__(self, networks: ReturnNetworks, seeds: Sequence[int]) -> None:
        self.networks, self.seeds = networks, tuple(seeds)
        self.critic_inputs, self.layout = networks.critic_inputs, networks.layout
        self.config = config = networks.config
        self.optimiser: StackedAdam | KFACRegression = component("critic_update", config.critic_update).make(
            config, networks.network, config.critic_lr or config.lr
        )

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        """Train on the returns of the rows where `estimate.present`; return metrics (R,).

        `loss` is the mean squared error in normalised units, cut off at `value_clip` like RLlib's
        vf_clip_param; `explained_variance` is that of the values before training.
        """
        config, layout = self.config, self.layout
        moments = self.networks.return_moments
        selected = layout.selection(estimate.present)
        targets = torch.from_numpy(layout.grouping.gather(estimate.returns, layout.replicas)).to(
            layout.device
        )
        if config.normalise_values:
            moments.include(targets[..., None], selected)
            targets = (targets - moments.mean[..., 0]) / moments.std[..., 0]
        targets = targets.to(layout.dtype)
        hidden_states, length = estimate.hidden_states, config.model.sequence_length
        sequences = None if hidden_states is None else hidden_states.sequences(layout, length)
        schedule = MinibatchSchedule(
            selected, sequences, self._generators(iteration), config.epochs, config.minibatches,
            config.piece_samples, layout,
        )  # fmt: skip
        add_gradients = partial(self._add_gradients, estimate=estimate, targets=targets)
        compiled = compiled_critic_steps(
            self.networks.network, self.optimiser, estimate.inputs, estimate.taken, targets, config.value_clip
        )
        take_steps = compiled or autograd_steps(self.optimiser, add_gradients, 1)
        (loss,), _ = take_steps(schedule)
        self.networks.carry(hidden_states)
        return {
            "loss": mean_per_replica(loss, layout.replicas),
            "explained_variance": explained_variance(estimate, layout.replicas),
        }

    def _add_gradients(self, piece: Piece, estimate: CriticEstimate, targets: Tensor) -> Tensor:
        """Add a piece's gradients by autograd; return its share of the loss, (1, P)."""
        inputs, targets = piece.of(estimate.inputs), piece.of(targets)
        taken = None if estimate.taken is None else piece.of(estimate.taken)

        def loss(outputs: Tensor) -> Tensor:
            values = outputs[:, 0] if taken is None else outputs.gather(1, taken[:, None])[:, 0]
            return (squared_error(values, targets, self.config.value_clip) * piece.weight).sum(1)

        if isinstance(self.optimiser, KFACRegression):
            return self.optimiser.include(inputs, taken, piece.weight, loss)[None]
        losses = loss(self.networks.network(inputs, piece.timeline))
        torch.autograd.backward(losses.sum())
        return losses.detach()[None]

    def _generators(self, iteration: int) -> list[np.random.Generator]:
        networks, purpose = range(self.layout.grouping.num_policies), f"{self.networks.purpose} minibatch"
        return [generator(seed, purpose, k, iteration) for seed in self.seeds for k in networks]

    def update_normalisers(self, trajectory: Trajectory) -> None:
        """Include an iteration's inputs in the running statistics."""
        if self.config.normalise_observations:
            features = self.layout.rows(self.critic_inputs.features(CriticBatch.of_steps(trajectory)))
            selected = self.layout.selection(presence(trajectory.alive[:-1], self.critic_inputs))
            self.networks.input_moments.include(features, selected)

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its configured value."""
        self.optimiser.anneal(share)

    def state_dict(self) -> dict[str, Any]:
        """Return the states of networks, normalisers and optimiser, and the hidden states carried on."""
        state: dict[str, Any] = {
            "networks": self.networks.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        if self.config.model.core != "none":
            state["memory"] = self.networks.carried_state()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; raises RuntimeError if shapes differ."""
        self.networks.load_state_dict(state["networks"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.networks.load_carried(state.get("memory"))


class RegressionCritic(ReturnRegression):
    """A critic that is trained by regression on its estimated returns; a subclass adds `estimate`."""

    Inputs: ClassVar[type[CriticInputs]]
    """What the networks observe."""
    purpose: ClassVar[str] = "critic"
    """See `ReturnNetworks`: different for each critic of a learner."""
    exchangeable_agents = False

    def __init__(
        self,
        config: CriticConfig,
        spec: EnvSpec,
        grouping: Grouping,
        seeds: Sequence[int],
        device: torch.device,
        dtype: torch.dtype,
        outputs: int = 1,
    ) -> None:
        """`outputs`: number of outputs of a network."""
        critic_inputs, self.spec = self.Inputs(config, spec, grouping), spec
        layout = Layout(critic_inputs.grouping, len(seeds), device, dtype)
        networks = ReturnNetworks(config, critic_inputs, outputs, seeds, layout, self.purpose)
        super().__init__(networks, seeds)

    def bootstrap_generators(self, iteration: int) -> list[np.random.Generator]:
        """Return a generator per replica for the actions at bootstrap values, where none were taken."""
        return [generator(seed, "critic bootstrap actions", iteration) for seed in self.seeds]


def squared_error(values: Tensor, targets: Tensor, bound: float | None) -> Tensor:
    """Return (values - targets)^2, cut at `bound` as RLlib's vf_clip_param does."""
    error = (values - targets).square()
    return error if bound is None else error.clamp(max=bound)


def adam(config: AdamConfig, network: nn.Module, lr: float) -> StackedAdam:
    """Return the optimiser of `critic_update: adam`."""
    return StackedAdam(network.parameters(), lr, config.grad_clip)


def kfac(config: KFACCriticConfig, network: nn.Module, lr: float) -> KFACRegression:
    """Return the optimiser of `critic_update: kfac`."""
    return KFACRegression(network, config, lr, config.critic_kl_bound)


def explained_variance(estimate: CriticEstimate, replicas: int) -> NDArray[np.float64]:
    """Return 1 - Var(returns - values) / Var(returns) per replica, (R,); NaN if returns do not vary."""
    result = np.full(replicas, np.nan)
    steps, copies, viewpoints = estimate.present.shape
    shape = (steps, replicas, copies // replicas, viewpoints)
    for r in range(replicas):
        here = estimate.present.reshape(shape)[:, r]
        target = estimate.returns.reshape(shape)[:, r][here]
        value = estimate.values.reshape(shape)[:, r][here]
        if target.size and target.var() > 0:
            result[r] = 1 - (target - value).var() / target.var()
    return result
