"""What the metrics of an episode are."""

MEANINGS = {
    "reward": "mean reward of the CAVs, summed over steps",
    "crash_rate": "1 where a CAV crashed: the share of such episodes, in a mean",
    "merge_rate": "share of the CAVs that came past the ramp's end on the highway",
    "ramp_merge_rate": "the same of those CAVs that came by the ramp",
    "hdv_merge_rate": "the same of human drivers",
    "mean_speed_ms": "mean over steps of the CAVs' mean speed, m/s",
    "min_speed_ms": "lowest speed of any CAV, m/s",
    "min_gap_m": "least gap ahead of any CAV, m",
    "min_headway_s": "least gap over speed of any CAV, s",
    "steps": "steps of the episode",
    "interventions": "actions that the safety supervisor changed",
}
