"""Descriptions and units of the metrics of an episode."""

from headway_envs.intersection.config import TERMS

_TERM = "of the reward in use, mean over steps; `scaled` without weight, `paper` with its gain"
_OTHERS = "human drivers and automated vehicles without a slot"
METRIC_DESCRIPTIONS = {
    "team_return": "sum over steps of the team's reward, of the kind in use (scaled or paper)",
    "paper_return": "sum of the paper's reward over steps and acting AVs, whichever kind is in use",
    "collisions": "number of collisions, each between two vehicles",
    "inflow_vph": "vehicles that entered, per hour",
    "outflow_vph": "vehicles that left, per hour",
    "efficiency": "outflow divided by inflow",
    "inflow_warm_vph": "vehicles that entered after the warm-up, per hour",
    "outflow_warm_vph": "vehicles that left after the warm-up, per hour",
    "vehicles": "number of vehicles on the road, mean over steps",
    "pending": "number of vehicles waiting to enter, mean over steps",
    "speed": "mean speed over vehicles, then over steps with at least one, m/s",
    "speed_av": "mean speed of automated vehicles with a slot, as `speed`, m/s",
    "speed_hdv": f"mean speed of {_OTHERS}, as `speed`, m/s",
    "acceleration_av": "mean absolute acceleration over the vehicles and steps of `speed_av`, m/s^2",
    "acceleration_hdv": "mean absolute acceleration over the vehicles and steps of `speed_hdv`, m/s^2",
    "hardest_braking_av": "hardest braking of any automated vehicle with a slot, m/s^2",
    "hardest_braking_hdv": f"hardest braking of any of {_OTHERS}, m/s^2",
    "fuel_gal_s": "mean fuel rate over vehicles, then over steps with at least one, gallons/s",
    "standstill_share": "share of vehicles slower than 0.1 m/s, mean over steps with at least one",
    "avs": "number of automated vehicles that entered, with or without a slot",
    "avs_through": "number of automated vehicles with a slot that left at their exit",
    "avs_without_slot": "number of automated vehicles beyond env.args.slots, driven by SUMO",
    "travel_time_av_s": "mean travel time of the vehicles of `avs_through`, s; the episode's length if none",
    "worst_approach_s": "time spent by AVs with a slot per AV that left, on the worst approach, s",
    "fairness_jain": "Jain's index of the time per AV that left, over the approaches: 1 if all are equal",
    "sumo_steps": "number of SUMO steps of 0.1 s in the episode; `length` counts actions",
    **{f"reward_{term}": f"term {term.replace('_', ' ')} {_TERM}" for term in TERMS},
}
METRICS = tuple(METRIC_DESCRIPTIONS)
"""Names, in the order of `EpisodeMetrics.metrics`."""
