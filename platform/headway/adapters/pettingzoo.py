"""Any PettingZoo ParallelEnv as a batch of copies, stepped one after another in this process.

Facts that PettingZoo has no place for are read from each agent's info, where present:

- `alive` (bool): the agent exists now; default: it is in `env.agents`
- `acting` (bool): the action just given was used; default: the agent was alive
- `action_mask` (bool, (A,)): actions allowed now; for MultiDiscrete the masks of its choices, concatenated
- `slot_ended` (`terminated` or `truncated`): for agents that are slots, the slot's agent is gone and this
  step's observation is its last; another agent may take the slot later
- `episode_metrics` (name -> number): metrics of the episode that just ended, in any agent's info

`metadata["episode_metrics"]` names the metrics, and `metadata["agents_come_and_go"]` says that agents may be
absent before the episode ends.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import isfinite
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from headway.adapters.spaces import Space, action_decoder, action_space, observation_size
from headway.contracts import (
    EnvSpec,
    HeadwayError,
    Observations,
    StepResult,
    child_seeds,
)
from headway.contracts.environment import step_arrays, step_result
from headway.contracts.errors import EnvironmentRaisedError, one_line
from headway.contracts.spaces import allows_action

Answer = TypeVar("Answer")
Infos = Mapping[str, Mapping[str, Any]]
StepAnswer = tuple[Mapping[str, Any], Mapping[str, float], Mapping[str, bool], Mapping[str, bool], Infos]
_MALFORMED = (TypeError, ValueError, KeyError, AttributeError, IndexError)
"""Exceptions raised when a value that an environment returned does not have PettingZoo's form."""
_RESET_FORM = "(observations, infos)"


@dataclass(frozen=True)
class AdapterOptions:
    """Facts about an environment that PettingZoo has no place for."""

    shared_reward: bool | None = None
    """All agents get the same reward at every step; None: no, with a notice if rewards look shared."""
    groups: tuple[str, ...] = ()
    """Group of each agent; empty: all in one."""
    agents_come_and_go: bool | None = None
    """Agents may be absent before the episode ends; None: as stated by metadata and infos."""
    metrics: tuple[str, ...] | None = None
    """Names of the episode metrics; None: those in the environment's metadata."""
    max_copies_per_process: int | None = None
    """Maximum number of copies in one process; None: no limit."""


NO_OPTIONS = AdapterOptions()


class ParallelEnv(Protocol):
    """The part of PettingZoo's ParallelEnv that the adapter uses."""

    possible_agents: list[str]
    agents: list[str]

    def observation_space(self, agent: str) -> Space: ...

    def action_space(self, agent: str) -> Space: ...

    def reset(self, seed: int | None = None) -> tuple[Mapping[str, Any], Infos]: ...

    def step(self, actions: dict[str, Any]) -> StepAnswer: ...

    def state(self) -> NDArray[Any]: ...

    def render(self) -> Any: ...  # noqa: ANN401 - a picture, text or nothing

    def close(self) -> None: ...

    @property
    def unwrapped(self) -> Any: ...  # noqa: ANN401 - PettingZoo comes without types


def episode_seed(copy_seed: int, episode: int = 0) -> int:
    """Return the seed with which an episode of a copy resets a PettingZoo or Gymnasium environment: 31 bits.

    `copy_seed`: a seed as in `BatchedEnv.reset`, such as one of `child_seeds`.
    """
    return int(child_seeds(copy_seed, "episode", episode, 1)[0]) & 0x7FFFFFFF


class ParallelEnvBatch:
    """C copies of a ParallelEnv as a `BatchedEnv`, without snapshots.

    `possible_agents` are the N slots. An agent that is terminated or truncated is not alive until the next
    reset. A copy whose `agents` is empty has ended its episode and is reset with the seed
    `episode_seed(seeds[copy], episode)`. When an episode ends, absent agents are marked like the episode
    itself, with their last observation; agents that had ended before are marked as terminated again. If the
    environment sets both flags, the agent is terminated. With `shared_reward`, slots of absent agents get the
    team's reward.

    NaN and infinity are passed on: the caller checks values, since it can name the copies.

    Raises HeadwayError for spaces that differ between agents or are not supported, live agents without an
    observation or a reward, entries for agents that are not in `possible_agents`, agents that leave early
    without `agents_come_and_go`, rewards that differ despite `shared_reward`, and episodes that end without
    the declared metrics.
    """

    def __init__(
        self,
        make_parallel_env: Callable[[], Any],
        copies: int,
        name: str,
        options: AdapterOptions = NO_OPTIONS,
    ) -> None:
        """Create the copies; `name` is used in messages."""
        if copies < 1:
            raise HeadwayError(f"environment '{name}' needs at least 1 copy, not {copies}")
        self._envs: list[ParallelEnv] = [make_parallel_env() for _ in range(copies)]
        first = self._envs[0]
        agents = tuple(getattr(first, "possible_agents", ()))
        if not agents:
            raise HeadwayError(
                f"environment '{name}' has no possible_agents; list every agent that can appear"
            )
        metadata = getattr(first, "metadata", {})
        metrics, agents_come_and_go = options.metrics, options.agents_come_and_go
        if metrics is None:
            metrics = metadata.get("episode_metrics", ())
        observation_spaces, action_spaces = (
            {agent: _call(name, kind, partial(getattr(first, kind), agent)) for agent in agents}
            for kind in ("observation_space", "action_space")
        )
        size = observation_size(name, observation_spaces)
        actions = action_space(name, action_spaces)
        try:
            _, infos = _call(name, "reset", partial(first.reset, seed=0))
        except (TypeError, ValueError) as error:
            raise _malformed(name, 0, _RESET_FORM, error) from error
        if agents_come_and_go is None:
            agents_come_and_go = bool(metadata.get("agents_come_and_go", _any_info_has(infos, "alive")))
        self._spec = EnvSpec(
            name=name,
            agents=agents,
            observation_size=size,
            action_space=actions,
            state_size=_state_size(name, first),
            groups=options.groups,
            shared_reward=bool(options.shared_reward),
            has_action_mask=_any_info_has(infos, "action_mask"),
            agents_come_and_go=agents_come_and_go,
            metrics=tuple(metrics),
            max_copies_per_process=options.max_copies_per_process,
        )
        self._index = {agent: index for index, agent in enumerate(agents)}
        self._has_masks = self._spec.has_action_mask
        self._flat = observation_spaces[agents[0]].shape == (size,)
        self._decode = action_decoder(action_spaces[agents[0]])
        self._allocate(copies)

    def _allocate(self, copies: int) -> None:
        spec = self._spec
        self._seeds = [0] * copies
        self._episodes = [0] * copies
        self._steps = 0
        self._live_agents: list[list[str] | None] = [None] * copies
        """Agents that the environment needs actions for; None: all, in order."""
        self._ended = np.zeros((copies, spec.num_agents), dtype=np.bool_)
        """Agents whose stream has ended in this episode."""
        if spec.has_action_mask and not spec.action_space.options:
            raise HeadwayError(f"environment '{spec.name}' returns action masks for Box actions; omit them")
        arrays = step_arrays(spec, copies)
        masks = arrays["masks"] if spec.has_action_mask else None
        self._observed = Observations(arrays["observations"], arrays["states"], arrays["alive"], masks)
        self._outcome = step_result(arrays)
        self._outcome.metrics.fill(np.nan)

    @property
    def spec(self) -> EnvSpec:
        return self._spec

    @property
    def num_copies(self) -> int:
        return len(self._envs)

    @property
    def parallel_envs(self) -> Sequence[ParallelEnv]:
        """The C copies."""
        return self._envs

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        if len(seeds) != self.num_copies:
            raise ValueError(f"reset takes one seed per copy: {self.num_copies}, not {len(seeds)}")
        self._seeds = [int(seed) for seed in seeds]
        self._steps = 0
        for copy in range(self.num_copies):
            self._begin(copy, episode=0)
        self._check()
        return self._observed

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        outcome = self._outcome
        outcome.terminated.fill(False)
        outcome.truncated.fill(False)
        outcome.episode_ended.fill(False)
        np.copyto(outcome.acting, self._observed.alive)
        self._steps += 1
        for copy in range(self.num_copies):
            self._step_copy(copy, actions[copy])
        self._check()
        return outcome, self._observed

    def snapshot(self) -> Any:  # noqa: ANN401 - the contract's type
        """Raise HeadwayError: PettingZoo environments cannot be saved."""
        raise HeadwayError(
            f"environment '{self._spec.name}' has no snapshots; its episodes restart on resume"
        )

    def restore(self, snapshot: Any) -> Observations:  # noqa: ANN401 - the contract's type
        """Raise HeadwayError: PettingZoo environments cannot be saved."""
        raise HeadwayError(
            f"environment '{self._spec.name}' has no snapshots; its episodes restart on resume"
        )

    def close(self) -> None:
        for env in self._envs:
            env.close()

    def _begin(self, copy: int, episode: int) -> None:
        env = self._envs[copy]
        self._episodes[copy] = episode
        seed = episode_seed(self._seeds[copy], episode)
        answer = _call(self._spec.name, "reset", partial(env.reset, seed=seed))
        self._ended[copy] = False
        self._observed.observations[copy] = 0
        try:
            self._read_reset(copy, answer)
        except _MALFORMED as error:
            raise _malformed(self._spec.name, self._steps, _RESET_FORM, error) from error
        self._read_state(copy, self._observed.states)

    def _read_reset(self, copy: int, answer: tuple[Mapping[str, Any], Infos]) -> None:
        observations, infos = answer
        self._write_observations(copy, observations)
        self._update_alive(copy)
        self._read_infos(copy, infos, after_reset=True)
        self._require_observations(observations, self._observed.alive[copy])

    def _step_copy(self, copy: int, actions: NDArray[Any]) -> None:
        agents, live = self._spec.agents, self._live_agents[copy]
        decoded = self._decode(actions)
        if live is None:
            given = dict(zip(agents, decoded, strict=True))
        else:
            given = {agent: decoded[self._index[agent]] for agent in live}
        answer = _call(self._spec.name, "step", partial(self._envs[copy].step, given))
        try:
            self._read_step(copy, live, answer)
        except _MALFORMED as error:
            form = "(observations, rewards, terminations, truncations, infos)"
            raise _malformed(self._spec.name, self._steps, form, error) from error
        has_ended = self._outcome.episode_ended[copy]
        self._read_state(copy, self._outcome.final_states if has_ended else self._observed.states)
        if has_ended:
            self._begin(copy, self._episodes[copy] + 1)

    def _read_step(self, copy: int, live: list[str] | None, answer: StepAnswer) -> None:
        """Read what the environment returned; `live`: see `_live_agents`."""
        env, agents = self._envs[copy], self._spec.agents
        observations, rewards, terminated, truncated, infos = answer
        self._write_observations(copy, observations)
        self._require_rewards(copy, rewards)
        self._outcome.rewards[copy] = self._slot_rewards(rewards, live)
        ended = False
        # Fast path of most steps: no stream ended and every agent is in `env.agents`.
        if (
            live is None
            and len(env.agents) == len(agents)
            and True not in terminated.values()
            and True not in truncated.values()
        ):
            if self._spec.agents_come_and_go:
                self._observed.alive[copy] = ~self._ended[copy]
        else:
            ended = self._end_streams(copy, terminated, truncated)
            self._update_alive(copy)
        if self._has_masks or any(infos.values()):
            self._read_infos(copy, infos, after_reset=False)
        # The return of a truncated agent continues with the value of its last observation.
        truncated_now = self._outcome.truncated[copy] & self._outcome.acting[copy]
        self._require_observations(observations, self._observed.alive[copy] | truncated_now)
        if ended:
            self._end_episode(copy, infos)

    def _read_state(self, copy: int, states: NDArray[np.float32]) -> None:
        """Write a copy's global state, if the environment has one, to its row of `states` (C, S)."""
        name, size = self._spec.name, self._spec.state_size
        if not size:
            return
        state = _call(name, "state", self._envs[copy].state)
        try:
            states[copy] = np.reshape(state, size)
        except (TypeError, ValueError) as error:
            raise HeadwayError(
                f"environment '{name}' returned a state at step {self._steps} that is not {size} numbers, as "
                "after its first reset; return an array of one size"
            ) from error

    def _write_observations(self, copy: int, observations: Mapping[str, Any]) -> None:
        rows, agents = self._observed.observations[copy], self._spec.agents
        try:
            # One call takes a third to two thirds of the time of N assignments.
            if self._flat and len(observations) == len(agents):
                np.concatenate([observations[agent] for agent in agents], out=rows.reshape(-1))
                return
            for agent, observation in observations.items():
                rows[self._index[agent]] = np.asarray(observation).reshape(-1)
        except (KeyError, ValueError, TypeError) as error:
            self._require_known("an observation", observations)
            shapes = {agent: np.shape(observation) for agent, observation in observations.items()}
            raise HeadwayError(
                f"environment '{self._spec.name}' returned observations of shapes {shapes} where each agent "
                f"should get {self._spec.observation_size} numbers; fix its observation_space"
            ) from error

    def _require_observations(self, observations: Mapping[str, Any], due: NDArray[np.bool_]) -> None:
        """Raise HeadwayError if an agent in `due` (N,) has no observation; an older one would be used in its
        place."""
        if len(observations) < len(self._spec.agents):
            self._require_given("observation", observations, due)

    def _require_rewards(self, copy: int, rewards: Mapping[str, float]) -> None:
        """Raise HeadwayError if an agent that had to act has no reward, or if an unknown agent has one."""
        if len(rewards) == len(self._spec.agents) and rewards.keys() == self._index.keys():
            return
        self._require_known("a reward", rewards)
        self._require_given("reward", rewards, self._outcome.acting[copy])

    def _require_known(self, what: str, given: Mapping[str, Any]) -> None:
        for agent in given:
            if agent not in self._index:
                raise HeadwayError(
                    f"environment '{self._spec.name}' returned {what} for agent '{agent}' at step "
                    f"{self._steps}, which is not in its possible_agents; list every agent that can appear"
                )

    def _require_given(self, what: str, given: Mapping[str, Any], due: NDArray[np.bool_]) -> None:
        for index in np.flatnonzero(due):
            if (agent := self._spec.agents[index]) not in given:
                raise HeadwayError(
                    f"environment '{self._spec.name}' returned no {what} for agent '{agent}' at step "
                    f"{self._steps}; return one for every agent that is alive, and a last observation "
                    "for one that is truncated"
                )

    def _slot_rewards(self, rewards: Mapping[str, float], live: Sequence[str] | None) -> list[float]:
        """Return the reward of each slot (N,); `live` are the agents that had to act, None: all."""
        agents = self._spec.agents
        if not self._spec.shared_reward:
            return [rewards.get(agent, 0.0) for agent in agents]
        acting_agents = agents if live is None else live
        rewards_given = [float(rewards[agent]) for agent in acting_agents if agent in rewards]
        team = rewards_given[0] if rewards_given else 0.0
        if any(reward != team and isfinite(reward) for reward in rewards_given):
            listed = ", ".join(f"{agent} {rewards[agent]:g}" for agent in acting_agents if agent in rewards)
            raise HeadwayError(
                f"environment '{self._spec.name}' should give all agents the same reward but returned "
                f"{listed} at step {self._steps}; set env.shared_reward=false"
            )
        return [rewards.get(agent, team) if agent in acting_agents else team for agent in agents]

    def _update_alive(self, copy: int) -> None:
        """Set the alive mask from `env.agents`; infos may change it afterwards."""
        live = self._envs[copy].agents
        unknown = [agent for agent in live if agent not in self._index]
        if unknown:
            raise HeadwayError(
                f"environment '{self._spec.name}' has agent '{unknown[0]}', which is not in its "
                "possible_agents; list every agent that can appear"
            )
        all_live = len(live) == len(self._spec.agents)
        self._live_agents[copy] = None if all_live else list(live)
        alive = self._observed.alive[copy]
        alive[:] = all_live
        if not all_live:
            alive[[self._index[agent] for agent in live]] = True
        alive &= ~self._ended[copy]

    def _end_streams(
        self,
        copy: int,
        terminated: Mapping[str, bool],
        truncated: Mapping[str, bool],
    ) -> bool:
        """Mark the streams that end in this step; return whether the episode ended."""
        outcome, env = self._outcome, self._envs[copy]
        terminations, truncations = outcome.terminated[copy], outcome.truncated[copy]
        ended_before, finals = self._ended[copy], outcome.final_observations[copy]
        for index, agent in enumerate(self._spec.agents):
            terminations[index] = terminated.get(agent, False)
            truncations[index] = truncated.get(agent, False) and not terminations[index]
        ending = terminations | truncations
        finals[ending] = self._observed.observations[copy, ending]
        episode_ended = not env.agents or bool((ending | ended_before).all())
        if episode_ended:
            # The contract marks every agent at the end of an episode, absent ones included.
            away = ~(ending | ended_before)
            finals[away] = self._observed.observations[copy, away]
            by_termination = bool(terminations.any() and not truncations.any())
            terminations |= away if by_termination else False
            truncations |= False if by_termination else away
            terminations |= ended_before & ~ending
        ended_before |= ending
        return episode_ended

    def _end_episode(self, copy: int, infos: Infos) -> None:
        outcome = self._outcome
        outcome.episode_ended[copy] = True
        metrics: Mapping[str, float] | None = next(
            (info["episode_metrics"] for info in infos.values() if info and "episode_metrics" in info), None
        )
        if metrics is None:
            metrics = {}
            if self._spec.metrics:
                raise HeadwayError(
                    f"environment '{self._spec.name}' declares episode_metrics, but an episode ended "
                    "without them in any agent's info; a wrapper must pass infos on"
                )
        outcome.metrics[copy] = [metrics.get(name, np.nan) for name in self._spec.metrics]

    def _read_infos(self, copy: int, infos: Infos, after_reset: bool) -> None:
        """Apply the infos; `after_reset`: no action has been given yet."""
        observed, masks = self._observed, self._observed.action_masks
        alive, acting = observed.alive[copy], self._outcome.acting[copy]
        if masks is not None:
            masks[copy] = True
        for index, agent in enumerate(self._spec.agents):
            info = infos.get(agent)
            if not info:
                continue
            if "alive" in info:
                alive[index] &= bool(info["alive"])
            if "acting" in info and not after_reset:
                acting[index] &= bool(info["acting"])
            if "slot_ended" in info and not after_reset:
                self._end_slot(copy, index, info["slot_ended"])
            if "action_mask" in info:
                if masks is None:
                    raise HeadwayError(
                        f"environment '{self._spec.name}' returned an action_mask for agent '{agent}' at "
                        f"step {self._steps} but none after its first reset; return one after every reset "
                        "and step"
                    )
                masks[copy, index] = info["action_mask"]

    def _end_slot(self, copy: int, index: int, how: str) -> None:
        """End the stream of a slot's agent while the slot remains."""
        outcome = self._outcome
        if how not in ("terminated", "truncated"):
            raise HeadwayError(
                f"environment '{self._spec.name}' returned {how!r} as slot_ended of agent "
                f"'{self._spec.agents[index]}'; write terminated or truncated"
            )
        if outcome.terminated[copy, index] or outcome.truncated[copy, index]:
            return
        (outcome.terminated if how == "terminated" else outcome.truncated)[copy, index] = True
        outcome.final_observations[copy, index] = self._observed.observations[copy, index]

    def _check(self) -> None:
        alive, masks = self._observed.alive, self._observed.action_masks
        if not self._spec.agents_come_and_go and not alive.all():
            copy, agent = np.argwhere(~alive)[0]
            raise HeadwayError(
                f"environment '{self._spec.name}': agent '{self._spec.agents[agent]}' of copy {copy} is not "
                f"alive at step {self._steps}, before the episode's end; set env.agents_come_and_go=true, or "
                "keep it alive with the wrapper black_death_v3"
            )
        if masks is None:
            return
        if (stuck := np.argwhere(alive & ~allows_action(self._spec.action_space, masks))).size:
            copy, agent = stuck[0]
            raise HeadwayError(
                f"environment '{self._spec.name}' leaves agent '{self._spec.agents[agent]}' of copy {copy} "
                f"without an allowed action at step {self._steps}; its action_mask must allow at least one"
            )


def _call(name: str, call: str, function: Callable[[], Answer]) -> Answer:
    try:
        return function()
    except HeadwayError:
        raise
    except Exception as error:  # the environment's own code
        raise EnvironmentRaisedError(name, call, error) from error


def _malformed(name: str, step: int, form: str, error: Exception) -> HeadwayError:
    return HeadwayError(
        f"environment '{name}' returned a value at step {step} that cannot be read ({one_line(error)}); "
        f"return {form}, each a dictionary by agent, and list the live agents in `agents`"
    )


def _any_info_has(infos: Infos, key: str) -> bool:
    return any(key in info for info in infos.values() if info)


def _state_size(name: str, env: ParallelEnv) -> int:
    try:
        return int(np.size(env.state()))
    except (NotImplementedError, AttributeError):
        return 0
    except Exception as error:  # the environment's own code
        raise EnvironmentRaisedError(name, "state", error) from error
