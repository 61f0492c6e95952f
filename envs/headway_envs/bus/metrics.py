"""Descriptions and units of the metrics of a service day."""

METRIC_DESCRIPTIONS = {
    "mean_wait_min": "mean wait of passengers who boarded or still wait at the end of the day, minutes",
    "p95_wait_min": "95th percentile of the waits averaged in mean_wait_min, minutes",
    "captive_wait_min": "mean wait of captive passengers, who do not use the competing service, minutes",
    "excess_wait_min": "mean wait of random arrivals in excess of that at the target headways, minutes",
    "headway_cv": "coefficient of variation of headways over their targets, at departures from stops",
    "bunched_share": "share of departures with a headway below a quarter of the target",
    "denied_boardings": "number of times that a passenger was left behind by a full bus",
    "boardings": "number of boarding passengers",
    "lost_share": "share of arriving passengers who took the competing service or found no room to wait; not "
    "0 under a regular service unless env.args.captive_share=1",
    "occupancy_mean": "mean of load over capacity, at departures from stops",
    "occupancy_p95": "95th percentile of load over capacity, at departures from stops",
    "in_vehicle_min": "mean time aboard per boarding, minutes",
    "trip_time_spread_min": "90th percentile minus median of the durations of finished trips, minutes",
    "held_min_per_trip": "holding time at stops per finished trip, minutes",
    "breakdowns": "number of times that a bus broke down or ran out of fuel",
    "service_visits": "number of visits to a service centre",
    "fuel_used": "fuel used by all buses, in units; a full tank holds env.args.upkeep.fuel_capacity",
    "reward_service": "service component q of the team's reward, mean over control intervals, unweighted",
    "reward_efficiency": "efficiency component e, mean over control intervals, unweighted: 0 or less, for "
    "crowding and, with env.args.reward.preset=paper, for low occupancy",
    "reward_maintenance": "maintenance component m, mean over control intervals, unweighted: 0 or less, for "
    "breakdowns, low fuel and low uptime",
    "reward_regularity": "regularity component c, mean over control intervals, unweighted",
    "team_reward": "sum of the team's reward over the day, equal to the return with "
    "env.args.reward.scope=team: number of control intervals (length) * (0.4 reward_service + 0.1 "
    "reward_efficiency + 0.1 reward_maintenance + 0.4 reward_regularity), with the weights "
    "env.args.reward.service to env.args.reward.regularity",
}
METRICS = tuple(METRIC_DESCRIPTIONS)
"""Names, in the order in which the kernel fills them."""
