"""Any PettingZoo ParallelEnv as a batch of copies, stepped one after another in this process.

What PettingZoo has no place for travels in an agent's info, where present:
`alive` (bool: the agent exists now; default: it is in `env.agents`), `acting` (bool: the action just given
was used; default: the agent was alive), `action_mask` (bool, A: allowed now), `slot_ended` (`terminated` or
`truncated`: of agents that are slots, whoever had this one is gone, and observes its last in this step;
another may come to it later) and, when the episode ends, `episode_metrics` (name -> number, in any agent's
info). `metadata["episode_metrics"]` names the metrics and
`metadata["agents_come_and_go"]` says that agents may leave before the episode ends.
"""

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from headway.adapters.spaces import Space, action_decoder, action_space, observation_size
from headway.contracts import (
    Discrete,
    EnvSpec,
    HeadwayError,
    MultiDiscrete,
    Observations,
    StepResult,
    child_seeds,
)

Infos = Mapping[str, Mapping[str, Any]]


class ParallelEnv(Protocol):
    """The part of PettingZoo's ParallelEnv that is used here."""

    possible_agents: list[str]
    agents: list[str]

    def observation_space(self, agent: str) -> Space: ...

    def action_space(self, agent: str) -> Space: ...

    def reset(self, seed: int | None = None) -> tuple[Mapping[str, Any], Infos]: ...

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[Mapping[str, Any], Mapping[str, float], Mapping[str, bool], Mapping[str, bool], Infos]: ...

    def state(self) -> NDArray[Any]: ...

    def close(self) -> None: ...

    @property
    def unwrapped(self) -> Any: ...  # noqa: ANN401 - whatever the wrappers are around


def episode_seed(copy_seed: int, episode: int) -> int:
    """The seed that `reset` of the environment is given: 31 bits, which every library takes."""
    return int(child_seeds(copy_seed, "episode", episode, 1)[0]) & 0x7FFFFFFF


class ParallelEnvBatch:
    """C copies of a ParallelEnv as a `BatchedEnv`, without snapshots.

    `possible_agents` are the N slots. An agent that has terminated or been truncated is not alive until the
    next reset; a copy whose `agents` is empty has ended its episode and is reset with the seed
    `episode_seed(seeds[copy], episode)`. At the end of an episode the agents that were away are given the
    episode's own ending, with what they last observed, and those that had ended before are terminated again.
    Termination hides truncation where the environment sets both. With `shared_reward` the slots of agents
    that are gone are given the team's reward. NaN and infinity are passed on: whoever steps the batch looks
    for them, and knows what its copies are called.

    Raises HeadwayError for spaces that differ between agents or are not supported, for agents that leave
    early without `agents_come_and_go`, for rewards that differ with `shared_reward`, and for episodes that
    end without the metrics that were announced.
    """

    def __init__(
        self,
        make_parallel_env: Callable[[], Any],
        copies: int,
        name: str,
        *,
        shared_reward: bool = False,
        groups: Sequence[str] = (),
        agents_come_and_go: bool | None = None,
        metrics: Sequence[str] | None = None,
        max_copies_per_process: int | None = None,
    ) -> None:
        """`agents_come_and_go` and `metrics` default to what the environment's metadata and infos say."""
        if copies < 1:
            raise HeadwayError(f"environment '{name}' needs at least 1 copy, not {copies}")
        self._envs: list[ParallelEnv] = [make_parallel_env() for _ in range(copies)]
        first = self._envs[0]
        agents = tuple(getattr(first, "possible_agents", ()))
        if not agents:
            raise HeadwayError(
                f"environment '{name}' has no possible_agents; list every agent that can appear"
            )
        space = first.action_space(agents[0])
        metadata = getattr(first, "metadata", {})
        if metrics is None:
            metrics = metadata.get("episode_metrics", ())
        observation_spaces = {agent: first.observation_space(agent) for agent in agents}
        size = observation_size(name, observation_spaces)
        actions = action_space(name, {agent: first.action_space(agent) for agent in agents})
        _, infos = first.reset(seed=0)
        if agents_come_and_go is None:
            agents_come_and_go = bool(metadata.get("agents_come_and_go", _any_has(infos, "alive")))
        self._spec = EnvSpec(
            name=name,
            agents=agents,
            observation_size=size,
            action_space=actions,
            state_size=_state_size(first),
            groups=tuple(groups),
            shared_reward=shared_reward,
            has_action_mask=_any_has(infos, "action_mask"),
            agents_come_and_go=agents_come_and_go,
            metrics=tuple(metrics),
            max_copies_per_process=max_copies_per_process,
        )
        self._index = {agent: index for index, agent in enumerate(agents)}
        self._has_masks = self._spec.has_action_mask
        self._flat = observation_spaces[agents[0]].shape == (size,)
        self._decode = action_decoder(space)
        self._allocate(copies)

    def _allocate(self, copies: int) -> None:
        spec = self._spec
        n, d, s = spec.num_agents, spec.observation_size, spec.state_size
        self._seeds = [0] * copies
        self._episodes = [0] * copies
        self._steps = 0
        self._present: list[list[str] | None] = [None] * copies
        """Agents that the environment wants actions of; None: all, in order."""
        self._ended = np.zeros((copies, n), dtype=np.bool_)
        """Agents whose stream has ended in this episode."""
        masks = np.ones((copies, n, _num_actions(spec)), dtype=np.bool_) if spec.has_action_mask else None
        self._observed = Observations(
            observations=np.zeros((copies, n, d), dtype=np.float32),
            states=np.zeros((copies, s), dtype=np.float32),
            alive=np.zeros((copies, n), dtype=np.bool_),
            action_masks=masks,
        )
        self._outcome = StepResult(
            rewards=np.zeros((copies, n), dtype=np.float32),
            terminated=np.zeros((copies, n), dtype=np.bool_),
            truncated=np.zeros((copies, n), dtype=np.bool_),
            acting=np.zeros((copies, n), dtype=np.bool_),
            episode_ended=np.zeros(copies, dtype=np.bool_),
            final_observations=np.zeros((copies, n, d), dtype=np.float32),
            final_states=np.zeros((copies, s), dtype=np.float32),
            metrics=np.full((copies, len(spec.metrics)), np.nan),
        )

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
            raise ValueError(f"reset takes one seed a copy: {self.num_copies}, not {len(seeds)}")
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
        """Raises HeadwayError: PettingZoo has no way to save an environment."""
        raise HeadwayError(
            f"environment '{self._spec.name}' has no snapshots; its episodes restart on resume"
        )

    def restore(self, snapshot: Any) -> Observations:  # noqa: ANN401 - the contract's type
        """Raises HeadwayError, as `snapshot`."""
        raise HeadwayError(
            f"environment '{self._spec.name}' has no snapshots; its episodes restart on resume"
        )

    def close(self) -> None:
        for env in self._envs:
            env.close()

    def _begin(self, copy: int, episode: int) -> None:
        env = self._envs[copy]
        self._episodes[copy] = episode
        observations, infos = env.reset(seed=episode_seed(self._seeds[copy], episode))
        self._ended[copy] = False
        self._observed.observations[copy] = 0
        self._write_observations(copy, observations)
        self._note_present(copy)
        self._read_infos(copy, infos, fresh=True)
        if self._spec.state_size:
            self._observed.states[copy] = env.state().reshape(-1)

    def _step_copy(self, copy: int, actions: NDArray[Any]) -> None:
        env, agents, present = self._envs[copy], self._spec.agents, self._present[copy]
        decoded = self._decode(actions)
        if present is None:
            given = dict(zip(agents, decoded, strict=True))
        else:
            given = {agent: decoded[self._index[agent]] for agent in present}
        observations, rewards, terminated, truncated, infos = env.step(given)
        self._write_observations(copy, observations)
        self._outcome.rewards[copy] = self._paid(rewards, present)
        ended = False
        if (
            present is None
            and len(env.agents) == len(agents)
            and True not in terminated.values()
            and True not in truncated.values()
        ):
            if self._spec.agents_come_and_go:
                self._observed.alive[copy] = True
        else:
            ended = self._end_streams(copy, terminated, truncated)
            self._note_present(copy)
        if self._has_masks or any(infos.values()):
            self._read_infos(copy, infos, fresh=False)
        if ended:
            self._end_episode(copy, infos)
        elif self._spec.state_size:
            self._observed.states[copy] = env.state().reshape(-1)

    def _write_observations(self, copy: int, observations: Mapping[str, Any]) -> None:
        rows, agents = self._observed.observations[copy], self._spec.agents
        try:
            if self._flat and len(observations) == len(agents):
                np.concatenate([observations[agent] for agent in agents], out=rows.reshape(-1))
                return
            for agent, observation in observations.items():
                if agent in self._index:
                    rows[self._index[agent]] = np.asarray(observation).reshape(-1)
        except (KeyError, ValueError, TypeError) as error:
            shapes = {agent: np.shape(observation) for agent, observation in observations.items()}
            raise HeadwayError(
                f"environment '{self._spec.name}' gave observations of shapes {shapes} where each agent "
                f"should be given {self._spec.observation_size} numbers; mend its observation_space"
            ) from error

    def _paid(self, rewards: Mapping[str, float], present: Sequence[str] | None) -> list[float]:
        """(N,): what each slot is given, if `present` were there to act (None: all)."""
        agents = self._spec.agents
        if not self._spec.shared_reward:
            return [rewards.get(agent, 0.0) for agent in agents]
        there = agents if present is None else present
        paid = [float(rewards[agent]) for agent in there if agent in rewards]
        team = paid[0] if paid else 0.0
        if any(reward != team and isfinite(reward) for reward in paid):
            listed = ", ".join(f"{agent} {rewards[agent]:g}" for agent in there if agent in rewards)
            raise HeadwayError(
                f"environment '{self._spec.name}' should pay all agents the same, and paid {listed} at step "
                f"{self._steps}; set env.shared_reward=false"
            )
        return [rewards.get(agent, team) if agent in there else team for agent in agents]

    def _note_present(self, copy: int) -> None:
        """Who is there now, by `env.agents`; infos may say otherwise afterwards."""
        live = self._envs[copy].agents
        unknown = [agent for agent in live if agent not in self._index]
        if unknown:
            raise HeadwayError(
                f"environment '{self._spec.name}' has agent '{unknown[0]}', which is not in its "
                "possible_agents; list every agent that can appear"
            )
        everyone = len(live) == len(self._spec.agents)
        self._present[copy] = None if everyone else list(live)
        alive = self._observed.alive[copy]
        alive[:] = everyone
        if not everyone:
            alive[[self._index[agent] for agent in live]] = True
        alive &= ~self._ended[copy]

    def _end_streams(
        self,
        copy: int,
        terminated: Mapping[str, bool],
        truncated: Mapping[str, bool],
    ) -> bool:
        """Ends of a step in which not everybody just goes on; whether the episode ended."""
        outcome, env = self._outcome, self._envs[copy]
        over, cut, before = outcome.terminated[copy], outcome.truncated[copy], self._ended[copy]
        finals = outcome.final_observations[copy]
        for index, agent in enumerate(self._spec.agents):
            over[index] = terminated.get(agent, False)
            cut[index] = truncated.get(agent, False) and not over[index]
        now = over | cut
        finals[now] = self._observed.observations[copy, now]
        ended = not env.agents or bool((now | before).all())
        if ended:
            away = ~(now | before)
            finals[away] = self._observed.observations[copy, away]
            natural = bool(over.any() and not cut.any())
            over |= away if natural else False
            cut |= False if natural else away
            over |= before & ~now
        before |= now
        return ended

    def _end_episode(self, copy: int, infos: Infos) -> None:
        outcome = self._outcome
        outcome.episode_ended[copy] = True
        if self._spec.state_size:
            outcome.final_states[copy] = self._envs[copy].state().reshape(-1)
        metrics: Mapping[str, float] | None = next(
            (info["episode_metrics"] for info in infos.values() if info and "episode_metrics" in info), None
        )
        if metrics is None:
            metrics = {}
            if self._spec.metrics:
                raise HeadwayError(
                    f"environment '{self._spec.name}' announces episode_metrics, and an episode ended "
                    "without them in any agent's info; a wrapper must pass infos on"
                )
        outcome.metrics[copy] = [metrics.get(name, np.nan) for name in self._spec.metrics]
        self._begin(copy, self._episodes[copy] + 1)

    def _read_infos(self, copy: int, infos: Infos, fresh: bool) -> None:
        """`fresh`: of a reset, where nothing has been acted upon."""
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
            if "acting" in info and not fresh:
                acting[index] &= bool(info["acting"])
            if "slot_ended" in info and not fresh:
                self._end_slot(copy, index, info["slot_ended"])
            if masks is not None and "action_mask" in info:
                masks[copy, index] = info["action_mask"]

    def _end_slot(self, copy: int, index: int, how: str) -> None:
        """The stream of a slot's agent ends, and the slot stays."""
        outcome = self._outcome
        if how not in ("terminated", "truncated"):
            raise HeadwayError(
                f"environment '{self._spec.name}' gave {how!r} as slot_ended of agent "
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
                f"there at step {self._steps}, before the episode's end; set env.agents_come_and_go=true, or "
                "keep it there with the wrapper black_death_v3"
            )
        if masks is not None and (stuck := np.argwhere(alive & ~masks.any(axis=-1))).size:
            copy, agent = stuck[0]
            raise HeadwayError(
                f"environment '{self._spec.name}' allows agent '{self._spec.agents[agent]}' of copy {copy} "
                f"no action at step {self._steps}; its action_mask must allow at least one"
            )


def _any_has(infos: Infos, key: str) -> bool:
    return any(key in info for info in infos.values() if info)


def _num_actions(spec: EnvSpec) -> int:
    match spec.action_space:
        case Discrete(n=n):
            return n
        case MultiDiscrete(nvec=nvec):
            return sum(nvec)
    raise HeadwayError(f"environment '{spec.name}' gives action masks for Box actions; leave them out")


def _state_size(env: ParallelEnv) -> int:
    try:
        return int(np.size(env.state()))
    except (NotImplementedError, AttributeError):
        return 0
