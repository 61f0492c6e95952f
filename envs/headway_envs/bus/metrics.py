"""Descriptions and units of the metrics of a service day."""

METRIC_DESCRIPTIONS = {
    "mean_wait_min": "mean wait of passengers who boarded or still wait at the end of the day, minutes",
    "p95_wait_min": "95th percentile of the waits averaged in mean_wait_min, minutes",
    "captive_wait_min": "mean wait of captive passengers, who do not use the competing service, minutes",
    "excess_wait_min": "mean wait of random arrivals in excess of that at the target headways, minutes",
    "headway_cv": "coefficient of variation of headways over their targets, at departures from stops",
    "bunched_share": "share of departures with a headway below a quarter of the target",
    "denied_boardings": "number of times that a passenger was left behind by a full bus, or "
    "by one that skipped the stop or limited boarding",
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
    "holding_s_per_stop": "average holding per stop (AHD): holding time at stops per departure from a stop "
    "other than the first of a trip, s",
    "occupancy_dispersion": "average occupancy dispersion (AOD): variance over mean of the load of arriving "
    "buses, by stop of a pattern; mean over the stops with at least two arrivals (passengers)",
    "travel_min": "mean_wait_min plus in_vehicle_min, minutes",
    "queueing_min": "part of mean_wait_min that begins when the first bus leaves without the passenger, "
    "minutes",
    "schedule_deviation_s": "mean absolute difference between departure and planned time, at departures "
    "from all stops but the last, s",
    "headway_sd_s": "standard deviation of the headways at departure, by stop of a pattern over the day, s; "
    "mean over the stops with at least two headways",
    "headway_cv_by_stop": "coefficient of variation of the headways at departure, by stop of a pattern over "
    "the day, with the planned changes of headway; mean over the stops with at least two headways",
    "bunching_events": "number of times that a bus closes up: it leaves a stop with a headway below a "
    "quarter of the target, after a larger one at its last departure of the trip or as the first departure",
    "skipped_stops_per_trip": "number of stops skipped per finished trip",
    "limited_stops_per_trip": "number of stops with limited boarding per finished trip",
    "team_reward": "sum of the team's reward over the day, equal to the return with "
    "env.args.reward.scope=team: number of control intervals (length) * (0.4 reward_service + 0.1 "
    "reward_efficiency + 0.1 reward_maintenance + 0.4 reward_regularity), with the weights "
    "env.args.reward.service to env.args.reward.regularity",
}
METRICS = tuple(METRIC_DESCRIPTIONS)
"""Names, in the order in which the kernel fills them."""
