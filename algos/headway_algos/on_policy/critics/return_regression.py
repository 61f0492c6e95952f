"""Networks that learn returns, and how: what all critics have in common."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway.contracts import Trajectory, generator
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.hidden_states import HiddenStates
from headway_algos.batches.layout import Layout, Piece, even_slices
from headway_algos.batches.sequences import learning_batches
from headway_algos.config import AlgoConfig
from headway_algos.networks.gru import RecurrentNetwork, make_network
from headway_algos.networks.normalisation import RunningStatistics
from headway_algos.networks.timeline import Timeline
from headway_algos.on_policy.critics.critic_inputs import CriticInputs
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.reward_streams import RewardStreams, presence
from headway_algos.optim.adam import StackedAdam
from headway_algos.optim.fast_path import regression
from headway_algos.optim.gradient_steps import Learn, gradient_steps
from headway_algos.optim.kfac_regression import KFACRegression


class ReturnNetworks(nn.Module):
    """P networks, their input normalisers, and the moments of the returns that they speak in."""

    def __init__(
        self, config: AlgoConfig, view: CriticInputs, outputs: int, seeds: Sequence[int], layout: Layout
    ) -> None:
        super().__init__()
        self.config = config
        networks, model = view.grouping.num_policies, config.model
        sizes = (view.seen_size + view.indicator_size, outputs)
        self.network = make_network(model, seeds, networks, "critic", sizes, 1.0, layout.dtype)
        self.carried: NDArray[Any] | None = None
        """(C, W, M): what networks that remember did after the last trajectory they learned from."""
        self.input_moments = RunningStatistics(len(seeds) * networks, view.seen_size)
        self.return_moments = RunningStatistics(len(seeds) * networks, 1)
        self.to(layout.device)

    def inputs(self, seen: Tensor, indicators: Tensor | None) -> Tensor:
        """(P, B, input_size): what was seen (P, B, seen_size) in units of its running moments, cut at 10,
        then indicators (P, B, indicator_size) as they are."""
        if self.config.normalise_observations:
            seen = self.input_moments.normalised(seen)
        return seen if indicators is None else torch.cat([seen, indicators], dim=2)

    def predict(self, inputs: Tensor, memory: Tensor | None = None) -> Tensor:
        """Outputs (P, O, B) in units of return, in float64, of inputs (P, B, input_size) and, for networks
        that remember, of what they do before each row (P, B, M), in pieces that stay in the cache."""
        pieces = even_slices(inputs.shape[1], len(inputs), self.config.piece_samples)
        with torch.no_grad():
            parts = [
                self.network(
                    inputs[:, piece], None if memory is None else Timeline.of_moments(memory[:, piece])
                )
                for piece in pieces
            ]
            outputs = torch.cat(parts, dim=2).double()
        if self.config.normalise_values:
            outputs = outputs * self.return_moments.std + self.return_moments.mean
        return outputs

    def replayed(
        self, inputs: Tensor, trajectory: Trajectory, view: CriticInputs, layout: Layout
    ) -> HiddenStates | None:
        """What networks that remember do along a trajectory, from where the last one left them; of others
        None. `inputs` (P, B, input_size) are those of its steps."""
        if not isinstance(self.network, RecurrentNetwork):
            return None
        streams = RewardStreams.of(trajectory, view)
        keeps = np.broadcast_to(streams.present[:-1], streams.rewards.shape)
        start = self.carried
        if start is None:
            start = np.zeros((*keeps.shape[1:], self.config.model.gru_size))
        begins = streams.begins(trajectory, view)
        return HiddenStates.replayed(
            self.network, inputs, start, begins, keeps, layout, self.config.piece_samples
        )

    def carry(self, memories: HiddenStates | None) -> None:
        """Go on, at the next trajectory, from what was remembered at the end of this one."""
        if memories is not None:
            self.carried = memories.after_the_last_step[0]

    def carried_state(self) -> Tensor | None:
        """For a checkpoint."""
        return None if self.carried is None else torch.from_numpy(self.carried)

    def load_carried(self, state: Tensor | None) -> None:
        """Inverse of `carried_state`."""
        self.carried = None if state is None else state.cpu().numpy().copy()


class ReturnRegression:
    """Networks that regress on returns by minibatches, each with its own."""

    def __init__(
        self,
        config: AlgoConfig,
        view: CriticInputs,
        seeds: Sequence[int],
        networks: ReturnNetworks,
        layout: Layout,
    ) -> None:
        self.config, self.view, self.seeds = config, view, tuple(seeds)
        self.networks, self.layout = networks, layout
        self.optimiser = _optimiser(config, networks.network)

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        """Learn the returns where present. `loss`, (R,), is the mean squared error in normalised units;
        `explained_variance`, (R,), is of the values before.

        With `value_clip` the squared error is cut there, as RLlib's vf_clip_param does.
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
        memories, length = estimate.memories, config.model.sequence_length
        sequences = None if memories is None else memories.sequences(layout, length)
        generators = self._generators(iteration)
        compiled: Learn | None = None
        if isinstance(self.optimiser, StackedAdam):
            network, optimiser = self.networks.network, self.optimiser
            compiled = regression(network, optimiser, estimate.inputs, estimate.taken, targets, config)
        batches = learning_batches(
            selected, sequences, generators, config.epochs, config.minibatches,
            None if compiled else config.piece_samples, layout,
        )  # fmt: skip
        learn = compiled or partial(self._learn, estimate=estimate, targets=targets)
        (loss,), _ = gradient_steps(self.optimiser, batches, learn, 1)
        self.networks.carry(memories)
        by_network = loss.double().cpu().numpy().reshape(layout.replicas, -1)
        return {
            "loss": by_network.mean(axis=1),
            "explained_variance": explained_variance(estimate, layout.replicas),
        }

    def _learn(self, piece: Piece, estimate: CriticEstimate, targets: Tensor) -> Tensor:
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
        networks = range(self.layout.grouping.num_policies)
        return [generator(seed, "critic minibatch", k, iteration) for seed in self.seeds for k in networks]

    def absorb(self, trajectory: Trajectory) -> None:
        """Add an iteration's inputs to the normaliser's statistics."""
        if self.config.normalise_observations:
            seen = self.layout.rows(self.view.seen(CriticBatch.of_steps(trajectory)))
            selected = self.layout.selection(presence(trajectory.alive[:-1], self.view))
            self.networks.input_moments.include(seen, selected)

    def anneal(self, share: float) -> None:
        """Set the learning rate to `share` of its base."""
        self.optimiser.anneal(share)

    def state_dict(self) -> dict[str, Any]:
        """Networks, normalisers, the optimiser, and what is remembered."""
        state: dict[str, Any] = {
            "networks": self.networks.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        if self.config.model.core != "none":
            state["memory"] = self.networks.carried_state()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; raises RuntimeError where shapes differ."""
        self.networks.load_state_dict(state["networks"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.networks.load_carried(state.get("memory"))


def squared_error(values: Tensor, targets: Tensor, bound: float | None) -> Tensor:
    """Return (values - targets)^2, cut at `bound` as RLlib's vf_clip_param does."""
    error = (values - targets).square()
    return error if bound is None else error.clamp(max=bound)


def _optimiser(config: AlgoConfig, network: nn.Module) -> StackedAdam | KFACRegression:
    if config.critic_update == "kfac":
        return KFACRegression(network, config)
    return StackedAdam(network.parameters(), config.critic_lr or config.lr, config.grad_clip)


def explained_variance(estimate: CriticEstimate, replicas: int) -> NDArray[np.float64]:
    """1 - Var(returns - values) / Var(returns) of each replica, (R,); NaN where returns do not vary."""
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
