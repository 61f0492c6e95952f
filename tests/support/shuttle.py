"""Text of an environment in a user's file, for tests that write it to a folder."""

SHUTTLE = """
import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv

print("imported")
FARE = 1.0


class Shuttle(ParallelEnv):
    metadata = {"name": "shuttle"}

    def __init__(self, cars: int = 2, steps: int = 5, fare: float = 1.0):
        self.possible_agents, self.steps, self.fare = [f"car_{i}" for i in range(cars)], steps, fare

    def observation_space(self, agent):
        return Box(0, 1, (1,), np.float32)

    def action_space(self, agent):
        return Discrete(2)

    def reset(self, seed=None, options=None):
        self.time, self.agents = 0, list(self.possible_agents)
        return self.seen(), {agent: {} for agent in self.agents}

    def seen(self):
        return {agent: np.full(1, self.time / self.steps, np.float32) for agent in self.possible_agents}

    def step(self, actions):
        agents, self.time = self.agents, self.time + 1
        over = self.time == self.steps
        self.agents = [] if over else agents
        paid = {agent: FARE * self.fare * (i + 1) for i, agent in enumerate(agents)}
        ends = dict.fromkeys(agents, over)
        return self.seen(), paid, dict.fromkeys(agents, False), ends, {agent: {} for agent in agents}
"""
"""Car i is paid (i + 1) x FARE x fare at every step, whatever it does: an episode's return, the mean over
two cars, is 1.5 x 5 by default."""
