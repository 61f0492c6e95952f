"""Source of a scenario's tables: a built-in name or a folder."""

from headway_envs.bus.config import SCENARIOS
from headway_envs.bus.scenario.tables import Tables, read_tables


def scenario_tables(scenario: str, seed: int) -> Tables:
    """Return the tables of a built-in scenario, generated from `seed`, or of a scenario folder.

    Raises HeadwayError for a faulty folder.
    """
    if scenario in SCENARIOS:
        from headway_envs.bus.scenario.synthetic import generate

        return generate(scenario, seed)
    return read_tables(scenario)
