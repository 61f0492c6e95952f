"""What the metrics of an episode are."""

MEANINGS = {
    "team_reward": "reward of all buses, summed over them, as the published table has it",
    "steps": "steps of the episode",
    "moves": "moves of all buses",
    "waits": "waits of all buses",
    "service_visits": "services that buses had",
    "services_refused": "services that buses asked for and did not get",
    "occupancy_cost": "mean over moves of what counts against the reward for the bus's occupancy, 0 to 1",
    "uptime": "mean over moves of the bus's uptime, 0 to 1",
    "regularity": "mean over moves of the regularity that is paid for, 0 to 1",
    "efficiency": "mean over moves of the efficiency that is paid for, 0 to 1",
}
