"""Run all benchmarks of speed, or the named ones: `python -m benchmarks [NAME ...]`."""

import argparse
import platform
import sys

from benchmarks import (
    city,
    crossing,
    generated_networks,
    gpu,
    kernel,
    learning,
    lightness,
    merge,
    mixed_autonomy,
    ray_workers,
    store,
    training,
)
from headway.contracts.errors import HeadwayError

REPORTS = {
    "training": training.report,
    "kernel": kernel.report,
    "learning": learning.report,
    "city": city.report,
    "merge": merge.report,
    "crossing": crossing.report,
    "mixed_autonomy": mixed_autonomy.report,
    "generated_networks": generated_networks.report,
    "lightness": lightness.report,
    "store": store.report,
    "gpu": gpu.report,
    "ray": ray_workers.report,
}
ONLY_NAMED = ("mixed_autonomy", "generated_networks")
"""Tables of studies that need SUMO: they measure no speed."""


def main() -> None:
    """Print the reports named on the command line, or all but `ONLY_NAMED`."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure Headway's speed.")
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        help=f"{', '.join(REPORTS)} (default: all but {', '.join(ONLY_NAMED)})",
    )
    names = parser.parse_args().names or [name for name in REPORTS if name not in ONLY_NAMED]
    for name in names:
        if name not in REPORTS:
            parser.error(f"there is no benchmark {name!r}; choose from {', '.join(REPORTS)}")
    line = f"Python {platform.python_version()} on {platform.machine()}; no other load is assumed."
    print(line, file=sys.stderr)  # the rest is Markdown
    for name in names:
        try:
            REPORTS[name]()
        except HeadwayError as error:
            parser.exit(2, f"{name}: {error}\n")


if __name__ == "__main__":
    main()
