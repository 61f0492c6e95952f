"""Comparison with highway-env. Hundreds of seeds: `python -m tests.trials.merge_parity`."""

import sys

import pytest
from covering import pairwise, quick_or_slow

pytest.importorskip(
    "highway_env", reason="the oracle highway-env is not installed: pip install 'headway[dev]'"
)

from headway.contracts import HeadwayError
from tests.trials.merge_parity import PLAYS, TOLERANCE, Trial, compare, run

DRIVERS = {"highway-env": False, "study": True}
TRIALS = {"-".join(map(str, trial)): trial for trial in pairwise(DRIVERS, PLAYS, [1, 2])}


@pytest.mark.parametrize(("drivers", "play", "ramp_lanes"), quick_or_slow(TRIALS, *list(TRIALS)[::3]))
def test_every_step_equals_highway_envs(ramp_lanes: int, play: str, drivers: str) -> None:
    """Positions to 1e-9, lanes, masks and crashes exactly; every trial here has lane changes."""
    trial = Trial(ramp_lanes, density=3, play=play, seed=4, eager=DRIVERS[drivers], steps=80)
    verdict = compare(trial)
    assert verdict.faults == ()
    assert verdict.free <= TOLERANCE
    assert verdict.lane_changes > 0


def test_crashes_and_displacements_are_compared() -> None:
    verdict = compare(Trial(1, density=3, play="idle", seed=3, steps=90))
    assert verdict.contact
    assert verdict.faults == ()


def test_a_difference_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison can fail: drivers with another desired time gap are detected."""
    from tests.trials import merge_oracle

    monkeypatch.setattr(merge_oracle.Driver, "TIME_WANTED", 1.4)
    assert compare(Trial(1, density=3, play="idle", seed=4, steps=60)).faults


@pytest.mark.parametrize("words", [["many"], ["0"], ["1", "2"]])
def test_an_invalid_number_of_seeds_is_named(words: list[str]) -> None:
    with pytest.raises(HeadwayError, match=f"must be one whole number above 0, not '{' '.join(words)}'"):
        run(words)


def test_a_missing_oracle_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tests.trials.merge_oracle", None)
    with pytest.raises(HeadwayError, match=r"highway-env is missing: pip install 'headway\[dev\]'"):
        run(["1"])
