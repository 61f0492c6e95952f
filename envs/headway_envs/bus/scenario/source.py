"""Where a scenario's tables come from: its name, or its folder."""

from headway_envs.bus.config import SCENARIOS
from headway_envs.bus.scenario.tables import Tables, read_tables


def scenario_tables(scenario: str, seed: int) -> Tables:
    """The tables of a built-in scenario of that seed, or of a folder. Raises HeadwayError for faults."""
    if scenario in SCENARIOS:
        from headway_envs.bus.scenario.synthetic import generate

        return generate(scenario, seed)
    return read_tables(scenario)
