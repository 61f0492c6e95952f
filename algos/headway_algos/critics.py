"""Critics: what they look at, and how they learn returns."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from headway.contracts import EnvSpec, Trajectory
from headway_algos.acting import OBSERVATION_CLIP
from headway_algos.config import AlgoConfig
from headway_algos.experience import Endings, Layout, even_slices, minibatches, zero_where_absent
from headway_algos.grouping import Grouping
from headway_algos.networks import StackedMLP
from headway_algos.normalisation import RunningMoments
from headway_algos.optimiser import StackedAdam


class View(Protocol):
    """What a critic sees. W is the number of its viewpoints: N agents, or 1 for a whole team."""

    grouping: Grouping
    input_size: int
    team: bool
    """One value for the whole copy, of the shared reward."""

    def inputs(self, observations: NDArray[np.float32], states: NDArray[np.float32]) -> NDArray[np.float32]:
        """(T, C, N, D) and (T, C, S) -> (T, C, W, input_size)."""
        ...


class LocalView:
    """V(o): each agent's own observation, one critic a policy."""

    team = False

    def __init__(self, spec: EnvSpec, grouping: Grouping) -> None:
        self.grouping, self.input_size = grouping, spec.observation_size

    def inputs(self, observations: NDArray[np.float32], states: NDArray[np.float32]) -> NDArray[np.float32]:
        """The observations themselves."""
        return observations


class CentralView:
    """V(s): the global state, or all observations in a row where the environment gives none.

    One critic a replica for a shared team reward, else one a policy.
    """

    def __init__(self, spec: EnvSpec, grouping: Grouping) -> None:
        self.team = spec.shared_reward
        self.grouping = Grouping(np.zeros((1, 1), np.int64)) if self.team else grouping
        self.has_state = spec.state_size > 0
        self.input_size = spec.state_size or spec.num_agents * spec.observation_size
        self.viewpoints = 1 if self.team else spec.num_agents

    def inputs(self, observations: NDArray[np.float32], states: NDArray[np.float32]) -> NDArray[np.float32]:
        """The same state from every viewpoint."""
        seen = states if self.has_state else observations.reshape(*observations.shape[:2], -1)
        return np.broadcast_to(seen[:, :, None], (*seen.shape[:2], self.viewpoints, seen.shape[2]))


def _seen_at(
    endings: Endings, trajectory: Trajectory
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Observations, states and presence (F, R, ...) right after the step of each ending: final ones where
    they are valid, what came next for those who went on."""
    ended = endings.take(trajectory.terminated | trajectory.truncated)
    final_observations = endings.take(trajectory.final_observations)
    observations = np.where(ended[..., None], final_observations, endings.take(trajectory.observations[1:]))
    everyone = ended.all(axis=-1, keepdims=True)
    final_states = endings.take(trajectory.final_states)
    states = np.where(everyone, final_states, endings.take(trajectory.states[1:]))
    return observations, states, ended | endings.take(trajectory.alive[1:])


VIEWS: dict[str, type[LocalView] | type[CentralView]] = {"local": LocalView, "central": CentralView}


class Critic(nn.Module):
    """A stack of value networks over one view."""

    def __init__(
        self,
        config: AlgoConfig,
        spec: EnvSpec,
        grouping: Grouping,
        seeds: Sequence[int],
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        super().__init__()
        self.config = config
        self.view: View = VIEWS[config.critic](spec, grouping)
        self.layout = Layout(self.view.grouping, len(seeds), device, dtype)
        networks = self.view.grouping.num_policies
        sizes = (self.view.input_size, config.model.hidden, 1)
        self.network = StackedMLP(seeds, networks, "critic", sizes, config.model.activation, 1.0, dtype)
        self.input_moments = RunningMoments(len(seeds) * networks, self.view.input_size)
        self.return_moments = RunningMoments(len(seeds) * networks, 1)
        self.to(device)
        self.optimiser = StackedAdam(
            self.network.parameters(), config.critic_lr or config.lr, config.grad_clip
        )

    def present(self, alive: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(T, C, N) -> (T, C, W): where there is a value to speak of."""
        return np.ones((*alive.shape[:2], 1), np.bool_) if self.view.team else alive

    def rows(
        self, observations: NDArray[np.float32], states: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> Tensor:
        """Normalised network inputs (P, B, input_size)."""
        inputs = self.layout.rows(self.view.inputs(zero_where_absent(observations, alive), states))
        if not self.config.normalise_observations:
            return inputs
        moments = self.input_moments
        scaled = (inputs - moments.mean.to(inputs.dtype)) * moments.scale.to(inputs.dtype)
        return scaled.clamp_(-OBSERVATION_CLIP, OBSERVATION_CLIP)

    def _values(self, rows: Tensor, steps: int) -> NDArray[np.float64]:
        """Values of rows as (T, C, W), in units of return, computed in pieces that stay in the cache."""
        pieces = even_slices(rows.shape[1], len(rows), self.config.piece_samples)
        with torch.no_grad():
            values = torch.cat([self.network(rows[:, piece])[:, 0] for piece in pieces], dim=1).double()
        if self.config.normalise_values:
            values = values * self.return_moments.std[..., 0] + self.return_moments.mean[..., 0]
        return self.layout.by_agent(values, steps)

    def evaluate(
        self, trajectory: Trajectory, rows: Tensor
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values (T + 1, C, W) and, where truncated, values of the final observations (T, C, W).

        `rows` are the inputs of the first T steps.
        """
        steps = len(trajectory.rewards)
        last = self.rows(trajectory.observations[-1:], trajectory.states[-1:], trajectory.alive[-1:])
        values = np.concatenate([self._values(rows, steps), self._values(last, 1)])
        endings = Endings.of(trajectory, self.layout.replicas)
        if len(endings) == 0:
            return values, np.zeros_like(values[:-1])
        at_end = self.rows(*_seen_at(endings, trajectory))
        return values, endings.put(self._values(at_end, len(endings)), values[:-1].shape)

    def fit(
        self,
        rows: Tensor,
        returns: NDArray[np.float64],
        present: NDArray[np.bool_],
        generators: Sequence[np.random.Generator],
    ) -> Tensor:
        """Regress on returns (T, C, W) where present; (P,) mean squared error in normalised units.

        With `value_clip` the squared error is cut there, as RLlib's vf_clip_param does.
        """
        config, layout = self.config, self.layout
        selected = layout.selection(present)
        targets = torch.from_numpy(layout.grouping.gather(returns, layout.replicas)).to(layout.device)
        if config.normalise_values:
            self.return_moments.include(targets[..., None], torch.from_numpy(selected).to(layout.device))
            targets = (targets - self.return_moments.mean[..., 0]) / self.return_moments.std[..., 0]
        targets = targets.to(layout.dtype)
        loss_sum = torch.zeros(len(selected), device=layout.device, dtype=layout.dtype)
        steps = np.zeros(len(selected))
        for pieces, active in minibatches(
            selected, generators, config.epochs, config.minibatches, config.piece_samples, layout
        ):
            self.optimiser.begin()
            for piece in pieces:
                error = (self.network(piece.of(rows))[:, 0] - piece.of(targets)) ** 2
                if config.value_clip is not None:
                    error = error.clamp(max=config.value_clip)
                loss = (error * piece.weight).sum(1)
                loss.sum().backward()
                loss_sum += loss.detach()
            self.optimiser.step(active)
            steps += active
        return loss_sum / torch.from_numpy(steps).to(loss_sum).clamp(min=1)

    def absorb(self, trajectory: Trajectory) -> None:
        """Add an iteration's inputs to the normaliser's statistics (once an iteration, after learning)."""
        if not self.config.normalise_observations:
            return
        observations, alive = trajectory.observations[:-1], trajectory.alive[:-1]
        inputs = self.view.inputs(zero_where_absent(observations, alive), trajectory.states[:-1])
        selected = torch.from_numpy(self.layout.selection(self.present(alive))).to(self.layout.device)
        self.input_moments.include(self.layout.rows(inputs), selected)
