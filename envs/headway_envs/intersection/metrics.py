"""What the metrics of an episode are."""

from headway_envs.intersection.config import TERMS

_TERM = "of the reward in use: mean over steps; `scaled` unweighted, `paper` with its gains"
_OTHERS = "the same of all others: human drivers, and automated vehicles without a slot"
METRIC_DESCRIPTIONS = {
    "team_return": "the team's reward in use, scaled or the paper's, summed over steps",
    "paper_return": "the paper's reward, whichever is in use, summed over steps and AVs asked to act",
    "collisions": "collisions, each of two vehicles",
    "inflow_vph": "vehicles that entered, an hour",
    "outflow_vph": "vehicles that left, an hour",
    "efficiency": "outflow over inflow",
    "inflow_warm_vph": "vehicles that entered, an hour, after the warm-up",
    "outflow_warm_vph": "vehicles that left, an hour, after the warm-up",
    "vehicles": "vehicles on the road, mean over steps",
    "pending": "vehicles that wait to enter, mean over steps",
    "speed": "speed, mean over vehicles, then over the steps that have any, m/s",
    "speed_av": "the same of automated vehicles that have a slot, m/s",
    "speed_hdv": f"{_OTHERS}, m/s",
    "acceleration_av": "absolute acceleration, mean over the vehicles and steps of speed_av, m/s^2",
    "acceleration_hdv": "the same over those of speed_hdv, m/s^2",
    "hardest_braking_av": "hardest braking of any automated vehicle that has a slot, m/s^2",
    "hardest_braking_hdv": f"{_OTHERS}, m/s^2",
    "fuel_gal_s": "fuel of a vehicle, mean over vehicles, then over the steps that have any, gallons/s",
    "standstill_share": "share of vehicles slower than 0.1 m/s, mean over the steps that have any",
    "avs": "automated vehicles that came, with a slot or without",
    "avs_through": "automated vehicles with a slot that went through",
    "avs_without_slot": "automated vehicles beyond env.args.slots, which SUMO drove",
    "travel_time_av_s": "mean time on the road of those of avs_through, s; the episode's where none did",
    "worst_approach_s": "seconds AVs with a slot spent for each that went through, on the worst approach",
    "fairness_jain": "Jain's index of the same seconds over the approaches: 1 where equal",
    "sumo_steps": "steps of SUMO in the episode, 0.1 s each; `length` counts actions",
    **{f"reward_{term}": f"term {term.replace('_', ' ')} {_TERM}" for term in TERMS},
}
