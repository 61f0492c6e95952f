"""Descriptions and units of the metrics of a service day."""

MEANINGS = {
    "mean_wait_min": "mean wait of those who boarded or still wait at the end, minutes",
    "p95_wait_min": "95th percentile of the same waits, minutes",
    "captive_wait_min": "mean wait of those who wait however long it takes, minutes",
    "excess_wait_min": "mean wait at random arrivals, beyond that of buses at their target headways, minutes",
    "headway_cv": "coefficient of variation of headways over their targets, at departures from stops",
    "bunched_share": "share of departures less than a quarter of the target headway behind the bus before",
    "denied_boardings": "passengers left behind by a full bus, counted at each bus",
    "boardings": "passengers who boarded",
    "lost_share": "share of passengers who took the competing service or found no room to wait",
    "occupancy_mean": "mean of load over capacity, at departures from stops",
    "occupancy_p95": "95th percentile of the same",
    "in_vehicle_min": "passenger minutes aboard for each boarding",
    "trip_time_spread_min": "90th percentile less the median of the times of finished trips, minutes",
    "held_min_per_trip": "minutes that buses were held at stops, for each finished trip",
    "breakdowns": "times that a bus broke down or ran out of fuel",
    "service_visits": "visits to a service centre",
    "fuel_used": "fuel of all buses, in units of which a full tank has env.args.upkeep.fuel_capacity",
    "reward_service": "service component of the team's reward, mean over control intervals, unweighted",
    "reward_efficiency": "efficiency component, likewise: minus what crowding costs, and emptiness where "
    "env.args.reward.preset=paper",
    "reward_maintenance": "maintenance component, likewise: minus what breakdowns, low fuel and uptime cost",
    "reward_regularity": "regularity component, likewise",
    "team_reward": "the team's reward, summed over the day",
}
