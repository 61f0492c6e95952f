"""Command that waits until the head of a Ray cluster answers, or until the cluster has a number of nodes.

Usage: `python -m headway_launch.runner.cluster.ray_nodes HOST:PORT [NUMBER]`.
"""

import argparse
import sys
import time

from headway.contracts.errors import HeadwayError
from headway.rollout.workers.ray_cluster import connect, disconnect, require_answer, require_ray
from headway_launch.console.output import print_line

_PATIENCE_S = 300.0
_POLL_S = 0.5


def wait_for_nodes(address: str, number: int = 0, patience_s: float = _PATIENCE_S) -> None:
    """Wait until the head of the cluster answers and, unless `number` is 0, has that many live nodes.

    Raises HeadwayError with the reason after `patience_s` seconds, or at once if Ray is not installed.
    """
    require_ray()
    deadline = time.monotonic() + patience_s
    while True:
        try:
            require_answer(address)
            if number and (found := _nodes_of(address)) < number:
                raise HeadwayError(f"the Ray cluster at {address} has {found} of {number} nodes")
        except HeadwayError as error:
            if time.monotonic() > deadline:
                raise HeadwayError(f"after {patience_s:g} s: {error}") from error
            time.sleep(_POLL_S)
        else:
            return


def _nodes_of(address: str) -> int:
    """Return the number of live nodes. Raises HeadwayError if the cluster cannot be reached."""
    connect(address)
    import ray

    try:
        return len([node for node in ray.nodes() if node["Alive"]])
    finally:
        disconnect()


def main() -> None:
    """Run the command line of this module."""
    parser = argparse.ArgumentParser(description="Wait for the head of a Ray cluster, or for NUMBER nodes.")
    parser.add_argument("address", metavar="HOST:PORT")
    parser.add_argument("number", metavar="NUMBER", type=int, nargs="?", default=0)
    arguments = parser.parse_args()
    try:
        wait_for_nodes(arguments.address, arguments.number)
    except HeadwayError as error:
        print_line(f"headway: {error}")
        sys.exit(2)


if __name__ == "__main__":
    main()
