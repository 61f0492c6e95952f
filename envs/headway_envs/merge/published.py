"""Results of the study of MAPPO, MAACKTR and MADQN on ramps of one and two lanes, which plots curves only."""

from headway.contracts import PublishedResult, PublishedResults

_SOURCE = "the study of MAPPO, MAACKTR and MADQN on one and two ramp lanes: its text on the evaluation curves"
_FINDINGS = {"mappo": "scales", "maacktr": "does not", "madqn": "does not learn"}
_CAVEATS = (
    "Why the results differ. The published runs used the safety supervisor, which replaces actions that are "
    "predicted to end in a collision, without saying so: compare them with runs that set "
    "`env.args.supervisor=true`. Their evaluation samples actions and plays three episodes per point, so one "
    "crash, which costs 200, moves a point by about 70; ours is greedy and uses many held-out episodes. No "
    "published result reports crashes.",
    "The published MADQN could not learn: its step counter was reset every 100 steps, so at least 98.8% of "
    "its actions stayed random, and rewards were multiplied by 20 without clipping. Its MAPPO used a critic "
    "of state and action as the baseline and treated the time limit as termination. Headway's algorithms do "
    "not have these defects; `preset=merge_paper` has the published hyper-parameters.",
    "The position of the second ramp lane is not published in numbers: here it is parallel to the first, 4 m "
    "further out, and a vehicle on it must change lanes twice within 100 m. `merge_as_published` uses the "
    "older dynamics and the published protocol.",
)


def _results(rewards: dict[str, str]) -> PublishedResults:
    return PublishedResults(
        source=_SOURCE,
        results={
            algorithm: PublishedResult(ranges={"reward": text}, finding=_FINDINGS[algorithm])
            for algorithm, text in rewards.items()
        },
        caveats=_CAVEATS,
    )


ONE_RAMP_LANE = _results({"mappo": "0 to 70, mostly 20 to 60", "maacktr": "40 to 60", "madqn": "-100 to 50"})
"""Rewards per episode on `merge`."""
TWO_RAMP_LANES = _results(
    {"mappo": "25 to 50, at the end about 75", "maacktr": "10 to 20", "madqn": "-100 to 50"}
)
"""Rewards per episode on `merge_two_lane`."""
