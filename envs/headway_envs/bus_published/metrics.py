"""Descriptions and units of the metrics of an episode."""

METRIC_DESCRIPTIONS = {
    "team_reward": "sum of all buses' rewards over the episode, as in the published table",
    "steps": "number of steps of the episode",
    "moves": "number of MOVE actions of all buses",
    "waits": "number of WAIT actions of all buses",
    "service_visits": "number of visits to the service centre",
    "services_refused": "number of requests for service without fuel for the way",
    "occupancy_cost": "mean over moves of the occupancy cost o in the reward, 0 to 1",
    "uptime": "mean over moves of the uptime u in the reward, 0 to 1",
    "regularity": "mean over moves of the regularity h in the reward, 0 to 1",
    "efficiency": "mean over moves of the efficiency t in the reward, 0 to 1",
}
METRICS = tuple(METRIC_DESCRIPTIONS)
"""Names, in the order in which the kernel fills them."""
