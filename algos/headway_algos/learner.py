"""The on-policy learner: a critic, an update and an order, over one stack of policies."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, HeadwayError, Trajectory, generator
from headway_algos.actor import Actor
from headway_algos.advantages import generalised_advantages, with_teammates_values
from headway_algos.config import AlgoConfig
from headway_algos.critics import Critic
from headway_algos.experience import Layout, zero_where_absent
from headway_algos.grouping import Grouping
from headway_algos.orders import ORDERS
from headway_algos.policy_rows import PolicyRows, standardise
from headway_algos.updates import UPDATES


def resolve_device(device: str) -> torch.device:
    """`auto` is a GPU if torch sees one; raises HeadwayError for a device that is not there."""
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise HeadwayError("device: cuda was asked for, but torch sees no GPU; use device=auto or device=cpu")
    try:
        return torch.device(device)
    except RuntimeError:
        raise HeadwayError(f"device: {device!r} is no device; use device=auto, cpu or cuda") from None


class OnPolicyLearner:
    """Experience in, better parameters out: critic x update x order (see `headway.contracts.Learner`)."""

    def __init__(self, config: AlgoConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> None:
        self.config, self.spec, self.seeds = config, spec, tuple(seeds)
        self.device, self.dtype = resolve_device(device), getattr(torch, config.precision)
        self.grouping = Grouping.of(config.policies, spec)
        self.layout = Layout(self.grouping, len(seeds), self.device, self.dtype)
        policies = self.grouping.num_policies
        self.actor = Actor(config.model, spec, seeds, policies, self.dtype).to(self.device)
        self.policy_update = UPDATES[config.update](self.actor, config, self.layout)
        self.critic = Critic(config, spec, self.grouping, seeds, self.device, self.dtype)

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """The actor's tensors and its normaliser, by the names of `StackedActingPolicy`."""
        return self.actor.acting_parameters()

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """One iteration of learning: advantages, policies, critic, normalisers, in this order."""
        share = 1 - (1 - self.config.lr_end) * progress
        self.policy_update.anneal(share)
        self.critic.optimiser.anneal(share)
        inputs = self.critic.rows(trajectory.observations[:-1], trajectory.states[:-1], trajectory.alive[:-1])
        values, advantages, present = self._advantages(trajectory, inputs)
        info = self._improve_policies(trajectory, advantages, iteration)
        returns = advantages + values
        critic_loss = self.critic.fit(
            inputs, returns, present, self._generators("critic minibatch", iteration, True)
        )
        self._absorb(trajectory)
        self._refuse_divergence(iteration)
        metrics = {f"policy/{name}": self._per_replica(value) for name, value in info.items()}
        metrics["critic/loss"] = self._per_replica(critic_loss)
        metrics["critic/explained_variance"] = self._explained_variance(values, returns, present)
        return metrics

    def _advantages(
        self, trajectory: Trajectory, inputs: Tensor
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Values, advantages and presence (T, C, W), W viewpoints of the critic."""
        values, final_values = self.critic.evaluate(trajectory, inputs)
        rewards, terminated, truncated = trajectory.rewards, trajectory.terminated, trajectory.truncated
        if self.critic.view.team:
            # The team's return goes on until the episode ends, whoever is present.
            ended = np.logical_or(terminated, truncated).all(axis=2, keepdims=True)
            terminated = np.array(terminated.all(axis=2, keepdims=True))
            truncated = np.logical_and(ended, ~terminated)
            rewards = rewards[:, :, :1]
        present = self.critic.present(trajectory.alive)
        if self.spec.shared_reward and not present[-1].all():
            values, present = with_teammates_values(values, present)
        advantages = generalised_advantages(
            rewards.astype(np.float64), values, final_values, terminated, truncated, present,
            self.config.gamma, self.config.gae_lambda,
        )  # fmt: skip
        return values[:-1], advantages, present[:-1]

    def _improve_policies(
        self, trajectory: Trajectory, advantages: NDArray[np.float64], iteration: int
    ) -> dict[str, Tensor]:
        alive = trajectory.alive[:-1]
        used = alive & trajectory.acting
        selected = self.layout.selection(used)
        observations = self.layout.rows(zero_where_absent(trajectory.observations[:-1], alive))
        if self.config.normalise_observations:
            observations = self.actor.normalise(observations)
        masks = None
        if self.spec.has_action_mask:
            masks = self.layout.rows(trajectory.action_masks[:-1] | ~alive[..., None])
        rows = PolicyRows(
            observations,
            masks,
            self.layout.rows(zero_where_absent(trajectory.actions, used)),
            self.layout.rows(zero_where_absent(trajectory.log_probs, used)),
            selected,
        )
        by_policy = self.layout.rows(np.broadcast_to(advantages, alive.shape))
        if self.config.normalise_advantages:
            by_policy = standardise(by_policy, torch.from_numpy(selected).to(self.device))
        generators = self._generators("actor minibatch", iteration, False)
        in_order = [generator(seed, "agent order", iteration) for seed in self.seeds]
        return ORDERS[self.config.order](self.policy_update, rows, by_policy, generators, in_order)

    def _absorb(self, trajectory: Trajectory) -> None:
        """Update the normalisers from this iteration; they act from the next one on."""
        self.critic.absorb(trajectory)
        if self.config.normalise_observations:
            alive = trajectory.alive[:-1]
            rows = self.layout.rows(zero_where_absent(trajectory.observations[:-1], alive))
            self.actor.moments.include(rows, torch.from_numpy(self.layout.selection(alive)).to(self.device))

    def _refuse_divergence(self, iteration: int) -> None:
        """Raise HeadwayError where policies are no longer finite: workers would act on them all the same."""
        for array in self.acting_parameters().values():
            broken = ~np.isfinite(array).all(axis=(1, 2))
            if broken.any():
                replica, policy = divmod(int(broken.argmax()), self.grouping.num_policies)
                owner = self.grouping.owner(policy, self.spec)
                raise HeadwayError(
                    f"{self.config.name} diverged: the policy of {owner}, seed {self.seeds[replica]}, is not "
                    f"finite after iteration {iteration}; lower algo.lr and algo.critic_lr, or bound the "
                    "gradients by algo.grad_clip"
                )

    def _generators(self, purpose: str, iteration: int, for_critic: bool) -> list[np.random.Generator]:
        networks = (self.critic.view.grouping if for_critic else self.grouping).num_policies
        return [generator(seed, purpose, k, iteration) for seed in self.seeds for k in range(networks)]

    def _per_replica(self, values: Tensor) -> NDArray[np.float64]:
        """(P,) -> (R,): the mean over a replica's networks."""
        means: NDArray[np.float64] = values.double().cpu().numpy().reshape(len(self.seeds), -1).mean(axis=1)
        return means

    def _explained_variance(
        self, values: NDArray[np.float64], returns: NDArray[np.float64], present: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """1 - Var(returns - values) / Var(returns) of each replica, (R,); NaN where returns do not vary."""
        result = np.full(len(self.seeds), np.nan)
        steps, copies, viewpoints = present.shape
        shape = (steps, len(self.seeds), copies // len(self.seeds), viewpoints)
        for r in range(len(self.seeds)):
            here = present.reshape(shape)[:, r]
            target, value = returns.reshape(shape)[:, r][here], values.reshape(shape)[:, r][here]
            if target.size and target.var() > 0:
                result[r] = 1 - (target - value).var() / target.var()
        return result

    def state_dict(self) -> dict[str, Any]:
        """Networks and normalisers, what the update carries on, and the critic's optimiser."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "policy_update": self.policy_update.state_dict(),
            "critic_optimiser": self.critic.optimiser.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; raises RuntimeError where shapes differ."""
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.policy_update.load_state_dict(state["policy_update"])
        self.critic.optimiser.load_state_dict(state["critic_optimiser"])
