"""Signals and max pressure at the crossing of Yan and Wu let through as many vehicles as published."""

from importlib.util import find_spec

import pytest

from benchmarks.mixed_autonomy import CONTROLLERS, PUBLISHED, outflow

pytestmark = pytest.mark.skipif(find_spec("libsumo") is None, reason="SUMO (headway[sumo]) is not installed")
CASES = [
    (controller, demand, expected)
    for demand, published in PUBLISHED.items()
    for controller, expected in zip(CONTROLLERS, published, strict=True)
    if expected is not None and controller != "human"
]


@pytest.mark.slow
@pytest.mark.parametrize(("controller", "demand", "expected"), CASES)
def test_controllers_that_do_not_learn_agree_within_one_percent(
    controller: str, demand: str, expected: float
) -> None:
    """The published priority rule has a regime that SUMO 1.28 does not show; it is left out."""
    found, collided = outflow(controller, demand)
    assert found == pytest.approx(expected, rel=0.01)
    assert collided == 0
