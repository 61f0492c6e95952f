"""Data that all copies of a bus environment share: the network and its configuration.

Imports only numpy and the kernel's records, because every worker unpickles it; `prepare` makes it.
"""

import math
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from headway_envs.array_env import record
from headway_envs.bus.config import OBSERVATIONS, BusConfig, service_hours
from headway_envs.bus.kernel.layout import SCOPE_LINE, SCOPE_OWN, SCOPE_TEAM, SETTINGS, Network


@dataclass(frozen=True)
class Prepared:
    """Network and the configuration it was built for; picklable."""

    config: BusConfig
    network: Network
    lines: tuple[str, ...]
    """(L,) name of each line"""
    source: str
    """Source of the scenario, with its licence if stated."""

    @property
    def agents(self) -> tuple[str, ...]:
        """(N,) name of each slot, `LINE_NUMBER`."""
        first = self.network.line_slots
        return tuple(
            f"{line}_{n}" for i, line in enumerate(self.lines) for n in range(first[i + 1] - first[i])
        )

    @property
    def groups(self) -> tuple[str, ...]:
        """(N,) name of each slot's line."""
        return tuple(self.lines[i] for i in self.network.slot_line)

    @property
    def notices(self) -> tuple[str, ...]:
        """Line for the user if no trip leaves in the last three hours or more of the day."""
        last_h = self.network.trip_departure.max() / 3600.0
        if self.config.end_hour - last_h < 3.0:
            return ()
        _, end = service_hours(self.config.start_hour, last_h + self.network.line_trip.max() / 3600.0)
        end = min(end, self.config.end_hour)
        return (
            f"no trip leaves after {last_h:.1f} h: passengers left behind wait until the day ends, at "
            f"{self.config.end_hour} h; set env.args.end_hour={end}",
        )

    @property
    def full_state(self) -> bool:
        """Whether the state includes all agents' observations.

        `state=auto` includes them for up to 50 slots.
        """
        match self.config.state:
            case "auto":
                return len(self.network.slot_line) <= 50
            case state:
                return state == "full"

    @property
    def settings(self) -> NDArray[Any]:
        """The configuration as one SETTINGS record, shape (1,)."""
        return record(SETTINGS, _settings(self))


def _settings(prepared: Prepared) -> dict[str, float]:
    """Return the values of the SETTINGS fields by name.

    A value of the configuration that has the name of a field is passed on unchanged.
    """
    config = prepared.config
    noise, upkeep, reward, disruptions = config.noise, config.upkeep, config.reward, config.disruptions
    breakdown = disruptions.breakdown_hour
    others = (1.0 - config.captive_share) * config.arrivals_per_boarding
    given = {**vars(config), **vars(noise), **vars(upkeep)}
    further = config.further_actions
    return {
        **{name: given[name] for name in SETTINGS.fields or () if name in given},
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
        "scale_service": float(reward.scale_service),
        "foresee_upkeep": float(reward.foresee_upkeep),
        "low_occupancy": 0.6 if reward.preset == "paper" else 0.0,
        "scope": float({"team": SCOPE_TEAM, "line": SCOPE_LINE, "own": SCOPE_OWN}[reward.scope]),
        "weekday": float(config.day_type == "weekday"),
        "observation": float(OBSERVATIONS.index(config.observation)),
        "full_state": float(prepared.full_state),
        "slow_s": disruptions.slow_hour * 3600.0 if disruptions.slow != 1.0 else math.inf,
        "breakdown_s": 3600.0 * (breakdown or 0),
        "breakdown_bus": -1 if breakdown is None else disruptions.breakdown_bus,
        "late_s": disruptions.late_s,
        "late_bus": disruptions.late_bus if disruptions.late_s > 0.0 else -1,
        "holding": float(config.holds),
        **{
            f"{name}_action": config.hold_levels + further.index(name) if name in further else -1
            for name in ("skip", "limit")
        },
    }


def _breakdown_cost(prepared: Prepared) -> float:
    """Estimate the reward lost by a breakdown, until the bus is repaired.

    It is the reward of the bus itself under `scope=own`, else its share of the reward of its line or team.
    During this time m is -1, and c is -1 instead of 1. Two intervals between buses become one of twice the
    length, which leaves twice as many passengers waiting there, so the line's q falls by 2 / buses.
    """
    config, reward = prepared.config, prepared.config.reward
    intervals = (config.upkeep.broken_s + config.upkeep.service_s) / config.tick_s
    own = reward.scope == "own"
    buses = len(prepared.network.slot_line) / len(prepared.lines) if own else 1.0
    return intervals * (reward.maintenance + 2.0 * reward.regularity + 2.0 * reward.service / buses)
