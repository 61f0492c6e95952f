"""One policy at the junctions of ten generated road networks: trained on the first, played on all, beside
rules."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from headway.stats.intervals import paired_difference

POLICY, HUMAN = "ippo", "rule human"
"""Names of controllers as `headway compare` prints them."""
RULES = (HUMAN, "rule signal", "rule max_pressure", "rule virtual_signal", "rule full_throttle")
METRICS = ("outflow_vph", "collided_vehicles")
EPISODES = 2
GENERATE = (
    *("--rand", "--rand.iterations", "15", "--rand.neighbor-dist5", "0", "--rand.neighbor-dist6", "0"),
    *("--no-turnarounds", "true", "--default-junction-type", "traffic_light", "--no-warnings", "true"),
)
TRIPS = ("--fringe-factor", "max", "--flows", "20", "--insertion-rate", "2500", "--end", "2000")
TRAIN = (
    *("algo=ippo", "preset=mixed_autonomy", "study=transfer", "backend.parallel=1", "rollout.steps=2000"),
    *("start.rule=full_throttle", "start.env_steps=20_000", "start.critic_iterations=4", "algo.lr=1e-3"),
    *(
        "evaluation.every=200_000",
        "evaluation.episodes=1",
        "evaluation.final_episodes=2",
        "evaluation.rules=[]",
    ),
)


def _run(folder: Path, *command: str) -> str:
    """Return what a command prints that is run in `folder`."""
    done = subprocess.run(command, cwd=folder, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout


def _headway(folder: Path, *words: str) -> str:
    return _run(folder, sys.executable, "-m", "headway_launch", *words)


def generate(number: int, folder: Path) -> None:
    """Write the network `number`, N.net.xml, and traffic on it, N.rou.xml, with SUMO's programs."""
    import sumo  # of the package eclipse-sumo

    home, files = Path(sumo.SUMO_HOME), (f"{number}.net.xml", f"{number}.rou.xml")
    _run(folder, str(home / "bin" / "netgenerate"), *GENERATE, "--seed", f"{number}", "-o", files[0])
    trips = (str(home / "tools" / "randomTrips.py"), "-n", files[0], "-o", files[1], "--seed", f"{number}")
    _run(folder, sys.executable, *trips, *TRIPS)


def _on(number: int) -> tuple[str, str]:
    """Return the words that select a network and its traffic."""
    return f"env.args.network={number}.net.xml", f"env.args.demand={number}.rou.xml"


def played(number: int, folder: Path) -> dict[str, list[float]]:
    """Return, by metric, the means over episodes of the policy (greedy, mean over seeds) and `RULES`."""
    rules = ",".join(rule.removeprefix("rule ") for rule in RULES)
    options = ("--episodes", f"{EPISODES}", "--rules", rules, "--metrics", ",".join(METRICS))
    rows = json.loads(_headway(folder, "compare", "transfer", *_on(number), *options, "--format", "json"))
    means = {(row["metric"], row["controller"]): row["mean"] for row in rows}
    return {metric: [means[metric, name] for name in (POLICY, *RULES)] for metric in METRICS}


def report(networks: int = 10, seeds: int = 2, env_steps: int = 100_000) -> None:
    """Print outflow and collided vehicles of the policy and of rules on each network."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(1, networks + 1):
            generate(number, folder)
        trained = ("env=junctions", *_on(1), "env.args.approaches=4", f"seed=0..{seeds - 1}")
        print(_headway(folder, "run", *trained, *TRAIN, f"env_steps={env_steps}"), file=sys.stderr)
        found = [played(number, folder) for number in range(1, networks + 1)]
    for metric, title in zip(METRICS, ("Outflow, veh/h", "Collided vehicles per episode"), strict=True):
        print(f"\n## {title}, mean of {EPISODES} episodes (policy: of {seeds} seeds, greedy)\n")
        print_table(np.array([means[metric] for means in found]), 0 if metric == METRICS[0] else 1)


def print_table(means: NDArray[np.float64], digits: int) -> None:
    """Print the `means`, networks x controllers; below, those over all networks but the first and their
    differences from `human`, with 95% intervals by Student's t over networks."""
    print(f"| network | {' | '.join((POLICY, *(f'`{rule[5:]}`' for rule in RULES)))} |")
    print(f"|---|{'---:|' * means.shape[1]}")
    human = 1 + RULES.index(HUMAN)
    names = ["1 (training)", *map(str, range(2, len(means) + 1)), f"mean of 2 to {len(means)}"]
    for name, row in zip(names, [*means, means[1:].mean(axis=0)], strict=True):
        print(f"| {name} | {' | '.join(f'{value:,.{digits}f}' for value in row)} |")
    cells = []
    for number, ours in enumerate(means[1:].T):
        found = paired_difference(ours, means[1:, human])
        shown = f"{found.estimate:+,.{digits}f} [{found.low:,.{digits}f}, {found.high:,.{digits}f}]"
        cells.append("" if number == human else shown)
    print(f"| minus `human` [95%] | {' | '.join(cells)} |")
