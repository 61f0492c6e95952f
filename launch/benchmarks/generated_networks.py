"""One policy at the junctions of ten generated road networks: trained on the first, played on all, beside
rules."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from headway.contracts.errors import HeadwayError
from headway.stats.comparison import RULE
from headway.stats.intervals import paired_difference
from headway_envs.sumo_simulation import require_sumo

POLICY = "ippo"
RULES = ("human", "signal", "max_pressure", "virtual_signal", "full_throttle")
METRICS = (("outflow_vph", "Outflow, veh/h", 0), ("collided_vehicles", "Collided vehicles per episode", 1))
"""(metric, title, digits) of each table."""
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
    try:
        import sumo
    except ImportError as error:
        raise HeadwayError("SUMO's programs are missing: install the package eclipse-sumo") from error
    home, files = Path(sumo.SUMO_HOME), (f"{number}.net.xml", f"{number}.rou.xml")
    _run(folder, str(home / "bin" / "netgenerate"), *GENERATE, "--seed", f"{number}", "-o", files[0])
    trips = (str(home / "tools" / "randomTrips.py"), "-n", files[0], "-o", files[1], "--seed", f"{number}")
    _run(folder, sys.executable, *trips, *TRIPS)


def _words_of(number: int) -> tuple[str, str]:
    """Return the words that select a network and its traffic."""
    return f"env.args.network={number}.net.xml", f"env.args.demand={number}.rou.xml"


def mean_metrics(number: int, folder: Path) -> dict[str, list[float]]:
    """Return, by metric, the means over episodes of the policy (greedy, mean over seeds) and `RULES`."""
    metrics = [metric for metric, _, _ in METRICS]
    options = ("--episodes", f"{EPISODES}", "--rules", ",".join(RULES), "--metrics", ",".join(metrics))
    words = ("compare", "transfer", *_words_of(number), *options, "--format", "json")
    means = {(row["metric"], row["controller"]): row["mean"] for row in json.loads(_headway(folder, *words))}
    controllers = (POLICY, *(f"{RULE}{rule}" for rule in RULES))
    return {metric: [means[metric, name] for name in controllers] for metric in metrics}


def report(networks: int = 10, seeds: int = 2, env_steps: int = 100_000) -> None:
    """Print outflow and collided vehicles of the policy and of rules on each network."""
    require_sumo()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(1, networks + 1):
            generate(number, folder)
        trained = ("env=junctions", *_words_of(1), "env.args.approaches=4", f"seed=0..{seeds - 1}")
        print(_headway(folder, "run", *trained, *TRAIN, f"env_steps={env_steps}"), file=sys.stderr)
        found = [mean_metrics(number, folder) for number in range(1, networks + 1)]
    for metric, title, digits in METRICS:
        print(f"\n## {title}, mean of {EPISODES} episodes (policy: of {seeds} seeds, greedy)\n")
        print_table(np.array([means[metric] for means in found]), digits)


def print_table(means: NDArray[np.float64], digits: int) -> None:
    """Print the `means`, networks x controllers; below, those over all networks but the first and their
    differences from `human`, with 95% intervals by Student's t over networks."""
    print(f"| network | {' | '.join((POLICY, *(f'`{rule}`' for rule in RULES)))} |")
    print(f"|---|{'---:|' * means.shape[1]}")
    human = 1 + RULES.index("human")
    names = ["1 (training)", *map(str, range(2, len(means) + 1)), f"mean of 2 to {len(means)}"]
    for name, row in zip(names, [*means, means[1:].mean(axis=0)], strict=True):
        print(f"| {name} | {' | '.join(f'{value:,.{digits}f}' for value in row)} |")
    cells = []
    for number, ours in enumerate(means[1:].T):
        found = paired_difference(ours, means[1:, human])
        shown = f"{found.estimate:+,.{digits}f} [{found.low:,.{digits}f}, {found.high:,.{digits}f}]"
        cells.append("" if number == human else shown)
    print(f"| minus `human` [95%] | {' | '.join(cells)} |")
