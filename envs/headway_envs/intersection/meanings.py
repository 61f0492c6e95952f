"""What the metrics of an episode are."""

from headway_envs.intersection.config import TERMS

_TERM = "of the reward in use: mean over steps; `scaled` unweighted, `paper` with its gains"
MEANINGS = {
    "team_return": "the team's reward in use, scaled or the paper's, summed over steps",
    "paper_return": "the paper's reward, summed over AVs and steps, whichever is in use",
    "collisions": "collisions, each of two vehicles",
    "inflow_vph": "vehicles that entered, an hour",
    "outflow_vph": "vehicles that left, an hour",
    "efficiency": "outflow over inflow",
    "inflow_warm_vph": "vehicles that entered, an hour, after the warm-up",
    "outflow_warm_vph": "vehicles that left, an hour, after the warm-up",
    "vehicles": "vehicles on the road, mean over steps",
    "pending": "vehicles that wait to enter, mean over steps",
    "speed": "mean over steps of the vehicles' mean speed, m/s",
    "speed_av": "the same of automated vehicles, m/s",
    "speed_hdv": "the same of human drivers, m/s",
    "acceleration_av": "mean over steps of automated vehicles' mean absolute acceleration, m/s^2",
    "acceleration_hdv": "the same of human drivers, m/s^2",
    "hardest_braking_av": "hardest braking of any automated vehicle, m/s^2",
    "hardest_braking_hdv": "the same of human drivers, m/s^2",
    "fuel_gal_s": "fuel of a vehicle, mean over vehicles and steps, gallons a second",
    "standstill_share": "share of vehicles slower than 0.1 m/s, mean over steps",
    "avs": "automated vehicles that came",
    "avs_through": "automated vehicles that went through",
    "avs_without_slot": "automated vehicles beyond env.args.slots, which SUMO drove",
    "travel_time_av_s": "mean time of automated vehicles that went through, s; the episode's where none did",
    "worst_approach_s": "seconds AVs spent here for each that went through, on the worst of four approaches",
    "fairness_jain": "Jain's index of the same seconds over the approaches: 1 where equal",
    **{f"reward_{term}": f"term {term.replace('_', ' ')} {_TERM}" for term in TERMS},
}
