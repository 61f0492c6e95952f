"""Run all benchmarks, or the named ones: `python -m benchmarks [NAME ...]`."""

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


def main() -> None:
    """Print the reports named on the command line, or all of them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure Headway's speed.")
    parser.add_argument("names", metavar="NAME", nargs="*", help=", ".join(REPORTS))
    names = parser.parse_args().names or list(REPORTS)
    for name in names:
        if name not in REPORTS:
            parser.error(f"there is no benchmark {name!r}; choose from {', '.join(REPORTS)}")
    line = f"Python {platform.python_version()} on {platform.machine()}; no other load is assumed."
    print(line, file=sys.stderr)  # the rest is Markdown
    for name in names:
        REPORTS[name]()


if __name__ == "__main__":
    main()
