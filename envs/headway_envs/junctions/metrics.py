"""Metrics of an episode: descriptions, units and computation."""

from dataclasses import dataclass

from headway_envs.junctions.config import JunctionsConfig
from headway_envs.junctions.traffic import Changes, Traffic

_OTHERS = "human drivers and automated vehicles without a slot"
METRIC_DESCRIPTIONS = {
    "team_return": "vehicles that left minus the cost of collided ones, warm-up included",
    "outflow_vph": "vehicles that left at the end of their route, per hour",
    "inflow_vph": "vehicles that entered, per hour",
    "collided_vehicles": "number of vehicles that collided, at least two per collision",
    "speed": "mean speed over all vehicles and steps, m/s",
    "vehicles": "number of vehicles on the road, mean over steps",
    "waiting": "number of vehicles waiting to enter, mean over steps",
    "standing_s": "time that vehicles stand (below 0.1 m/s) per vehicle that left, s",
    "hardest_braking_av": "hardest braking of any automated vehicle with a slot, m/s^2",
    "hardest_braking_hdv": f"hardest braking of any of {_OTHERS}, m/s^2",
    "fuel_l_100km": "fuel per distance driven by all vehicles, litres per 100 km",
    "co2_g_km": "CO2 per distance driven by all vehicles, g/km",
    "avs": "number of automated vehicles on the road with a slot, mean over steps",
    "avs_without_slot": "number of automated vehicles beyond env.args.slots, driven by SUMO",
}
"""All but the first leave out the warm-up (`env.args.warm_up_s`)."""
METRICS = tuple(METRIC_DESCRIPTIONS)
STANDING = 0.1
"""Speed below which a vehicle counts as standing, m/s."""


@dataclass
class EpisodeMetrics:
    """Sums over the steps of an episode."""

    config: JunctionsConfig
    steps: int = 0
    """Steps taken, warm-up included."""
    team_return: float = 0.0
    counted: int = 0
    """Steps after the warm-up."""
    entered: int = 0
    arrived: int = 0
    collided: int = 0
    without_slot: int = 0
    waiting: int = 0
    vehicles: int = 0
    avs: int = 0
    standing: int = 0
    speed: float = 0.0
    hardest_av: float = 0.0
    hardest_hdv: float = 0.0
    fuel_ml_s: float = 0.0
    co2_mg_s: float = 0.0

    def count(self, changes: Changes, traffic: Traffic, reward: float) -> None:
        """Count one step."""
        self.steps += 1
        self.team_return += reward
        config = self.config
        warm_up = config.warm_up_s if config.warm_up_s < config.horizon * config.step_s else 0.0
        if self.steps * config.step_s <= warm_up:
            return
        self.counted += 1
        self.entered += changes.entered
        self.arrived += changes.arrived
        self.collided += changes.collided
        self.without_slot += changes.without_slot
        self.waiting += changes.waiting
        self.vehicles += len(traffic.vehicles)
        for vehicle in traffic.vehicles.values():
            self.speed += vehicle.speed
            self.standing += vehicle.speed < STANDING
            self.avs += vehicle.slot >= 0
        for automated, braking in traffic.braking:
            if automated:
                self.hardest_av = max(self.hardest_av, braking)
            else:
                self.hardest_hdv = max(self.hardest_hdv, braking)
        fuel, co2 = traffic.emissions()
        self.fuel_ml_s += fuel
        self.co2_mg_s += co2

    def metrics(self) -> list[float]:
        """Return the metrics in the order of `METRICS`."""
        steps, per_hour = max(self.counted, 1), 3600 / (max(self.counted, 1) * self.config.step_s)
        # Sums over steps of speeds and of rates have the same factor step_s.
        metres = max(self.speed, 1e-9)
        return [
            self.team_return,
            self.arrived * per_hour,
            self.entered * per_hour,
            self.collided,
            self.speed / max(self.vehicles, 1),
            self.vehicles / steps,
            self.waiting / steps,
            self.standing * self.config.step_s / max(self.arrived, 1),
            self.hardest_av,
            self.hardest_hdv,
            100.0 * self.fuel_ml_s / metres if self.speed else 0.0,
            self.co2_mg_s / metres if self.speed else 0.0,
            self.avs / steps,
            self.without_slot,
        ]
