"""Descriptions and units of the metrics of an episode."""

METRIC_DESCRIPTIONS = {
    "reward": "mean reward of the CAVs, summed over steps",
    "crash_rate": "1 if any CAV crashed, else 0; its mean is the share of such episodes",
    "merge_rate": "share of CAVs that passed the end of the ramp on the highway",
    "ramp_merge_rate": "merge_rate over the CAVs that started on a ramp lane",
    "hdv_merge_rate": "merge_rate over human-driven vehicles",
    "mean_speed_ms": "mean over steps of the CAVs' mean speed, m/s",
    "min_speed_ms": "lowest speed of any CAV, m/s",
    "min_gap_m": "minimum distance from any CAV to the vehicle ahead, centre to centre, at most 60, m",
    "min_headway_s": "minimum of that distance over the CAV's speed, s; 0 if no CAV moved",
    "steps": "number of steps of the episode",
    "interventions": "number of actions changed by the safety supervisor",
}
METRICS = tuple(METRIC_DESCRIPTIONS)
"""Names, in the order in which the kernel fills them."""
