"""A ParallelEnv in a separate process, so that PettingZoo's test can play two intersections at once."""

import multiprocessing
from multiprocessing.connection import Connection
from typing import Any

from gymnasium import spaces
from pettingzoo import ParallelEnv

from headway_envs.intersection.config import IntersectionConfig
from headway_envs.intersection.parallel import IntersectionSlotsParallelEnv


def _host(config: IntersectionConfig, pipe: Connection) -> None:
    env = IntersectionSlotsParallelEnv(config)
    while (call := pipe.recv()) is not None:
        name, arguments = call
        pipe.send((getattr(env, name)(**arguments), list(env.agents)))
    env.close()


class HostedEnv(ParallelEnv):  # type: ignore[misc]  # PettingZoo comes without types
    """A ParallelEnv whose simulation runs in another process, with its spaces in this one."""

    def __init__(self, config: IntersectionConfig) -> None:
        self._spaces = IntersectionSlotsParallelEnv(config)
        self.metadata = self._spaces.metadata
        self.possible_agents, self.agents = self._spaces.possible_agents, []
        context = multiprocessing.get_context("forkserver")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_host, args=(config, theirs), daemon=True)
        self._process.start()

    def observation_space(self, agent: str) -> spaces.Box:
        return self._spaces.observation_space(agent)

    def action_space(self, agent: str) -> spaces.Box:
        return self._spaces.action_space(agent)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:  # noqa: ANN401 - as PettingZoo has it
        return self._call("reset", {"seed": seed})

    def step(self, actions: dict[str, Any]) -> Any:  # noqa: ANN401 - as PettingZoo has it
        return self._call("step", {"actions": actions})

    def close(self) -> None:
        self._pipe.send(None)
        self._process.join(10)

    def _call(self, name: str, arguments: dict[str, Any]) -> Any:  # noqa: ANN401 - any method's
        self._pipe.send((name, arguments))
        answer, self.agents = self._pipe.recv()
        return answer
