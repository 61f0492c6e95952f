"""Preparation of a bus environment: the scenario is read or generated and its network built.

It runs once, in the parent process. The scenarios `line` and `corridor` need no pandas, the others do.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from headway_envs.bus.config import BusConfig
from headway_envs.bus.prepared import Prepared
from headway_envs.bus.scenario.network import build, build_from_arrays
from headway_envs.bus.scenario.source import scenario_tables
from headway_envs.bus.scenario.synthetic import FLEETS, META, generate_lines
from headway_envs.bus.scenario.tables import Tables

_NEVER = 1e9
"""Seconds per fuel unit, and hours of uptime, of a replay: too large for a bus to run out of either."""
REPLAY_FIXED: Mapping[str, float] = {
    "dispatch_window_s": 0.0,
    "recovery_share": 3.0,
    "noise.dispatch_s": 0.0,
    "upkeep.breakdowns_per_hour": 0.0,
    "upkeep.seconds_per_fuel_unit": _NEVER,
    "upkeep.uptime_hours": _NEVER,
}
"""Settings that `prepare_replay` overrides, by dotted name."""


def prepare(config: BusConfig) -> Prepared:
    """Read or generate the scenario and build its network. Raises HeadwayError for an unusable scenario."""
    if config.scenario in FLEETS:
        arrays, meta = generate_lines(config.scenario, config.scenario_seed), META
    else:
        tables = scenario_tables(config.scenario, config.scenario_seed)
        arrays, meta = tables.arrays(), tables.meta
    network, lines = build_from_arrays(arrays, meta, config)
    return Prepared(config, network, lines, source_of(meta))


def prepare_variant(config: BusConfig, other: Prepared) -> Prepared:
    """Prepare `config`, reusing the network of `other` if the configurations differ only in rewards.

    Rewards do not affect the network, and sharing it saves the seconds that generating a city takes.
    Configurations that differ otherwise are prepared anew.
    """
    if replace(config, reward=other.config.reward) == other.config:
        return replace(other, config=config)
    return prepare(config)


def foreseeing_upkeep(prepared: Prepared) -> Prepared:
    """Return the same environment with `reward.foresee_upkeep`, for `lookahead`: within its horizon a missed
    service has no consequence, since a bus runs out of fuel hours later."""
    reward = replace(prepared.config.reward, foresee_upkeep=True)
    return replace(prepared, config=replace(prepared.config, reward=reward))


def prepare_replay(config: BusConfig, tables: Tables) -> Prepared:
    """Prepare a replay for comparison with measurements: every trip leaves at its observed departure time.

    Observed departures already contain the delays of earlier trips and the effect of breakdowns, so nothing
    is added to them (`REPLAY_FIXED`): no decision before departure, no dispatch noise, no breakdowns and
    unlimited fuel. Each slot recovers for three times a trip's duration before its next trip, so that no late
    arrival delays a departure; there are therefore more slots than buses in the data. Raises HeadwayError for
    an unusable scenario.
    """
    config = replace(
        config,
        dispatch_window_s=REPLAY_FIXED["dispatch_window_s"],
        recovery_share=REPLAY_FIXED["recovery_share"],
        noise=replace(config.noise, dispatch_s=REPLAY_FIXED["noise.dispatch_s"]),
        upkeep=replace(
            config.upkeep,
            breakdowns_per_hour=REPLAY_FIXED["upkeep.breakdowns_per_hour"],
            seconds_per_fuel_unit=REPLAY_FIXED["upkeep.seconds_per_fuel_unit"],
            uptime_hours=REPLAY_FIXED["upkeep.uptime_hours"],
        ),
    )
    network, lines = build(tables, config, replay=True)
    return Prepared(config, network, lines, source_of(tables.meta))


def source_of(meta: Mapping[str, Any]) -> str:
    """Return the source of a scenario as stated in its metadata, or "unknown"."""
    return str(meta.get("source", "unknown"))
