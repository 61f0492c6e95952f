"""Compiled simulator of highway merges.

- `layout`: records
- `spawn`: start of an episode
- `lanes`, `control`, `drivers`, `motion`, `contact`: one simulation step
- `surroundings`, `rewards`, `observe`, `supervisor`: functions of the state
- `steps`: the functions that the environment calls
"""


def warm() -> None:
    """Compile every function, or load it from the cache, by one step of one copy."""
    import numpy as np

    from headway_envs.merge.config import MergeConfig
    from headway_envs.merge.env import MergeBatchedEnv
    from headway_envs.merge.kernel.drivers import write_human_actions
    from headway_envs.merge.prepared import prepare

    env = MergeBatchedEnv(prepare(MergeConfig(supervisor=True), ramp_lanes=2), 1)
    env.reset(np.zeros(1, np.uint64))
    actions = np.ones((1, env.spec.num_agents), np.int64)
    write_human_actions(env.network, env.settings, env.world, actions)
    env.step(actions)
