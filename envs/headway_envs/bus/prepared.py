"""Record shared by all copies of one bus environment, and functions that make it. Imports only numpy and the
kernel's records until one of these functions is called."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from headway_envs.bus.config import BusConfig
from headway_envs.bus.kernel.layout import PAY_LINE, PAY_OWN, PAY_TEAM, SETTINGS, Network

if TYPE_CHECKING:
    from headway_envs.bus.scenario.tables import Tables

_NEVER = 1e9
"""Replay only: seconds that one unit of fuel lasts, and hours until the uptime reaches 0; never reached."""
REPLAY_FIXED: Mapping[str, float] = {
    "dispatch_window_s": 0.0,
    "recovery_share": 3.0,
    "noise.dispatch_s": 0.0,
    "upkeep.breakdowns_per_hour": 0.0,
    "upkeep.seconds_per_fuel_unit": _NEVER,
    "upkeep.uptime_hours": _NEVER,
}
"""Settings that `prepare_replay` overrides in every configuration, by dotted name."""


@dataclass(frozen=True)
class Prepared:
    """Network and the configuration it was built for; picklable."""

    config: BusConfig
    network: Network
    lines: tuple[str, ...]
    """Name of each line (L)."""
    source: str
    """Source of the scenario, with its licence."""

    @property
    def agents(self) -> tuple[str, ...]:
        """(N,) one name per slot: `LINE_NUMBER`."""
        first = self.network.line_slots
        return tuple(
            f"{line}_{n}" for i, line in enumerate(self.lines) for n in range(first[i + 1] - first[i])
        )

    @property
    def groups(self) -> tuple[str, ...]:
        """(N,) name of each slot's line."""
        return tuple(self.lines[i] for i in self.network.slot_line)

    @property
    def full_state(self) -> bool:
        """Whether the state includes all agents' observations; `state=auto` includes them for up to 50
        slots."""
        match self.config.state:
            case "auto":
                return len(self.network.slot_line) <= 50
            case state:
                return state == "full"

    @property
    def settings(self) -> NDArray[Any]:
        """The configuration as one SETTINGS record, shape (1,)."""
        settings = np.zeros(1, SETTINGS)
        for name, value in _settings(self).items():
            settings[name] = value
        return settings


def _settings(prepared: Prepared) -> dict[str, float]:
    config = prepared.config
    noise, upkeep, reward = config.noise, config.upkeep, config.reward
    others = (1.0 - config.captive_share) * config.arrivals_per_boarding
    same = [
        "tick_s",
        "hold_s",
        "boarding_s",
        "alighting_s",
        "fixed_dwell_s",
        "dispatch_window_s",
        "minimum_layover_s",
        "capacity",
    ]
    same_noise = [
        "trip_sd",
        "day_sd",
        "evening_peak",
        "network_sd",
        "incident_probability",
        "incident_factor",
        "demand_day_sd",
        "demand_stop_hour_sd",
        "dispatch_s",
    ]
    same_upkeep = [
        "fuel_capacity",
        "idle_share",
        "warning",
        "wear_growth",
        "broken_s",
        "service_s",
        "service_below",
        "depot_gap_s",
    ]
    return {
        **{name: getattr(config, name) for name in same},
        **{name: getattr(noise, name) for name in same_noise},
        **{name: getattr(upkeep, name) for name in same_upkeep},
        "start_s": config.start_hour * 3600.0,
        "end_s": config.end_hour * 3600.0,
        "captive_arrivals": config.captive_share / (config.captive_share + others),
        "competing_share": config.competing_headway_share,
        "fuel_per_s": 1.0 / upkeep.seconds_per_fuel_unit,
        "uptime_per_s": 1.0 / (upkeep.uptime_hours * 3600.0),
        "hazard_per_s": upkeep.breakdowns_per_hour / 3600.0,
        "weight_service": reward.service,
        "weight_efficiency": reward.efficiency,
        "weight_maintenance": reward.maintenance,
        "weight_regularity": reward.regularity,
        "follower_share": reward.follower_share,
        "breakdown_cost": _breakdown_cost(prepared),
        "foresee_upkeep": float(reward.foresee_upkeep),
        "low_occupancy": 0.6 if reward.preset == "paper" else 0.0,
        "scope": float({"team": PAY_TEAM, "line": PAY_LINE, "own": PAY_OWN}[reward.scope]),
        "weekday": float(config.day_type == "weekday"),
        "observation": float(("paper", "published", "control").index(config.observation)),
        "full_state": float(prepared.full_state),
    }


def _breakdown_cost(prepared: Prepared) -> float:
    """Estimate the reward lost by a breakdown, until the bus is repaired: by the bus itself under
    `scope=own`, else by its share in the reward of its line or of the team.

    For that long m is -1, and c is -1 instead of 1. Two intervals between buses become one of twice the
    length, which leaves twice as many passengers waiting there, so the line's q falls by 2 / buses.
    """
    config, reward = prepared.config, prepared.config.reward
    intervals = (config.upkeep.broken_s + config.upkeep.service_s) / config.tick_s
    own = reward.scope == "own"
    buses = len(prepared.network.slot_line) / len(prepared.lines) if own else 1.0
    return intervals * (reward.maintenance + 2.0 * reward.regularity + 2.0 * reward.service / buses)


def prepare(config: BusConfig) -> Prepared:
    """Read or generate the scenario and build its network: once, in the parent process. Imports pandas.

    Raises HeadwayError for an unusable scenario.
    """
    from headway_envs.bus.scenario.network import build
    from headway_envs.bus.scenario.source import scenario_tables

    tables = scenario_tables(config.scenario, config.scenario_seed)
    network, lines = build(tables, config)
    return Prepared(config, network, lines, source_of(tables.meta))


def prepare_beside(config: BusConfig, other: Prepared) -> Prepared:
    """Prepare `config` with the network of `other` if the two configurations differ only in rewards, which do
    not affect the network; else prepare anew. Saves the seconds that generating a whole city takes."""
    if replace(config, reward=other.config.reward) == other.config:
        return replace(other, config=config)
    return prepare(config)


def prepare_replay(config: BusConfig, tables: "Tables | None" = None) -> Prepared:
    """Prepare a replay for comparison with measurements: every trip of the table leaves exactly at its
    observed departure time. Raises HeadwayError for an unusable scenario.

    Observed departures already contain the delays of earlier trips and the effect of breakdowns, so nothing
    is added to them (`REPLAY_FIXED`): no decision before departure, no dispatch noise, no breakdowns and
    unlimited fuel. Each slot recovers for three times a trip's time before its next trip, so that no late
    arrival delays a departure; there are therefore more slots than buses in the data. `tables`: the scenario,
    if already read.
    """
    from headway_envs.bus.scenario.network import build
    from headway_envs.bus.scenario.source import scenario_tables

    if tables is None:
        tables = scenario_tables(config.scenario, config.scenario_seed)
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
    """Return the source of a scenario from its metadata, or "unknown"."""
    return str(meta.get("source", "unknown"))
