"""What the metrics of an episode are."""

MEANINGS = {
    "reward": "mean reward of the CAVs, summed over steps",
    "crash_rate": "1 where a CAV crashed: the share of such episodes, in a mean",
    "merge_rate": "share of the CAVs that came past the ramp's end on the highway",
    "ramp_merge_rate": "the same of those CAVs that came by the ramp",
    "hdv_merge_rate": "the same of human drivers",
    "mean_speed_ms": "mean over steps of the CAVs' mean speed, m/s",
    "min_speed_ms": "lowest speed of any CAV, m/s",
    "min_gap_m": "least distance from any CAV to the next vehicle ahead, centre to centre, 60 at most, m",
    "min_headway_s": "least such distance over speed of any CAV, s; 0 where none ever moved",
    "steps": "steps of the episode",
    "interventions": "actions that the safety supervisor changed",
}
