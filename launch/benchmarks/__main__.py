"""Run all benchmarks, or the named ones: `python -m benchmarks [NAME ...]`."""

import platform
import sys

from benchmarks import (
    city,
    crossing,
    gpu,
    kernel,
    learning,
    lightness,
    merge,
    ray_workers,
    store,
    table3,
    training,
)

REPORTS = {
    "training": training.report,
    "kernel": kernel.report,
    "learning": learning.report,
    "city": city.report,
    "merge": merge.report,
    "crossing": crossing.report,
    "lightness": lightness.report,
    "store": store.report,
    "table3": table3.report,
    "gpu": gpu.report,
    "ray": ray_workers.report,
}


def main() -> None:
    """Print the reports named on the command line, or all of them."""
    names = sys.argv[1:] or list(REPORTS)
    unknown = [name for name in names if name not in REPORTS]
    if unknown:
        sys.exit(f"benchmarks: no benchmark '{unknown[0]}'; choose from {', '.join(REPORTS)}")
    print(f"Python {platform.python_version()} on {platform.machine()}; no other load is assumed.")
    for name in names:
        REPORTS[name]()


if __name__ == "__main__":
    main()
