"""Wait until a Ray cluster has so many nodes: `python -m headway_launch.nodes HOST:PORT NUMBER`."""

import argparse
import sys
import time

from headway.contracts.errors import HeadwayError
from headway.rollout.cluster import connect, disconnect
from headway_launch.telling import tell

_PATIENCE_S = 300.0
_POLL_S = 0.5


def wait_for_nodes(address: str, number: int, patience_s: float = _PATIENCE_S) -> None:
    """Return as soon as the cluster has so many nodes. Raises HeadwayError where it has not for so long."""
    deadline = time.monotonic() + patience_s
    while (found := _nodes_of(address)) is None or found < number:
        if time.monotonic() > deadline:
            has = "does not answer" if found is None else f"has {found} of {number} nodes"
            raise HeadwayError(f"the Ray cluster at {address} {has} after {patience_s:g} s")
        time.sleep(_POLL_S)


def _nodes_of(address: str) -> int | None:
    """How many live nodes there are; None where nobody answers."""
    try:
        connect(address)
    except HeadwayError:
        return None
    import ray

    try:
        return len([node for node in ray.nodes() if node["Alive"]])
    finally:
        disconnect()


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="Wait until a Ray cluster has so many nodes.")
    parser.add_argument("address", metavar="HOST:PORT")
    parser.add_argument("number", type=int)
    arguments = parser.parse_args()
    try:
        wait_for_nodes(arguments.address, arguments.number)
    except HeadwayError as error:
        tell(f"headway: {error}")
        sys.exit(2)


if __name__ == "__main__":
    main()
