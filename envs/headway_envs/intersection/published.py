"""Results of the paper that trains PPO, A3C and DDPG at an unsignalised intersection."""

from headway.contracts import PublishedResult, PublishedResults

INTERSECTION_PAPER = PublishedResults(
    source="the paper of PPO, A3C and DDPG at an unsignalised intersection, sections 6.1 to 6.4",
    seeds=1,
    results={
        "ippo": PublishedResult(
            {
                "paper_return": 855149,
                "sumo_steps": 1224.98,
                "inflow_vph": 2846,
                "outflow_vph": 323,
                "efficiency": 0.141,
                "collisions": 0.47,
                "speed": 6.20,
                "fuel_gal_s": 0.00020,
                "vehicles": 24.09,
            },
            label="PPO",
        ),
        "a3c": PublishedResult(
            {
                "paper_return": 887670,
                "sumo_steps": 1217.5,
                "inflow_vph": 5781,
                "outflow_vph": 735,
                "efficiency": 0.327,
                "collisions": 0.38,  # the paper also prints 0.25, but uses 0.38 in its comparison
                "speed": 10.97,
                "fuel_gal_s": 0.00021,
                "vehicles": 22.32,
            },
            label="A3C",
        ),
        "ddpg": PublishedResult(
            {
                "paper_return": 984433,
                "sumo_steps": 1500,
                "inflow_vph": 2246,  # derived: outflow over efficiency
                "outflow_vph": 757.67,
                "efficiency": 0.3374,
                "collisions": 0.3768,
                "speed": 12.90,
                "fuel_gal_s": 0.000664,
                "acceleration_av": 1.9688,
            },
            label="DDPG",
        ),
    },
    caveats=(
        "What cannot be compared. The paper reports one run per algorithm, without seeds or intervals, and "
        "sets peaks over training beside means. Its reward is summed over the agents and grows with "
        "congestion, because more vehicles are then present to be paid. The inflow it reports for A3C is "
        "higher than its demand can supply, and it prints two collision values for A3C. It does not state "
        "the share of automated vehicles; here it is one half. It mentions a baseline of 50 runs of human "
        "drivers without printing it; the table uses a rule instead.",
        "What the comparison shows. An untrained policy that draws accelerations at random comes close to "
        "the paper's PPO row (`python -m benchmarks crossing`), so that row is no evidence of learning.",
    ),
)
"""Metrics of one run per algorithm. Return and episode length are peaks over training, the return summed over
agents. Its baseline of human drivers is mentioned but not printed."""
