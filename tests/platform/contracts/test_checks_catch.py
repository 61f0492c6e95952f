"""Each check of the contract fails for an environment that violates it."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.adapters.conformance import CHECKS, play
from headway.contracts import EnvSpec, HeadwayError, ObservationFeature, Observations, StepResult
from headway_envs.toy.visitors import Visitors, VisitorsConfig

FEATURES = tuple(ObservationFeature(f"x{i}", f"number {i}") for i in range(4))


class Broken(Visitors):
    """Visitors with one violation: `change` names how the result of each step is modified."""

    def __init__(self, copies: int, change: str, promises: Mapping[str, Any]) -> None:
        super().__init__(VisitorsConfig(), copies)
        self._change, self._calls = change, 0
        self._promised = dataclasses.replace(super().spec, **promises)

    @property
    def spec(self) -> EnvSpec:
        return self._promised

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        outcome, observed = super().step(actions)
        self._calls += 1
        match self._change:
            case "act while away":
                outcome.acting.fill(True)
            case "set both ends":
                outcome.truncated[outcome.episode_ended] = True
                outcome.terminated[outcome.episode_ended] = True
            case "leave one running":
                outcome.terminated[:, 0] = outcome.truncated[:, 0] = False
            case "allow nothing":
                assert observed.action_masks is not None
                observed.action_masks[:, :3] = False
            case "pay by call":
                outcome.rewards[:] += self._calls % 11
            case "pay by neighbour":
                outcome.rewards[:] += outcome.rewards[-1].sum()
            case "pay the team where it acted":
                outcome.rewards[:] = outcome.acting
            case "spoil metrics":
                outcome.metrics.fill(np.nan)
            case "spoil step 4" if self._calls == 4:
                observed.observations[1] = np.nan
        return outcome, observed


@pytest.mark.parametrize(
    ("check", "change", "spec"),
    [
        ("alive", "act while away", {}),
        ("alive", "", {"agents_come_and_go": False}),
        ("ends", "set both ends", {}),
        ("ends", "leave one running", {}),
        ("ends", "spoil metrics", {}),
        ("masks", "allow nothing", {}),
        ("shared reward", "", {"shared_reward": True}),
        ("shared reward", "pay the team where it acted", {"shared_reward": True}),
        ("shared reward", "", {"shared_in_groups": True}),
        ("shared reward", "", {"shared_in_groups": True, "groups": ("a", "a", "b", "b", "c", "c")}),
        ("determinism", "pay by call", {}),
        ("copies", "pay by neighbour", {}),
        ("snapshots", "pay by call", {}),
        ("snapshots", "", {"snapshots": False}),
        ("spec", "", {"groups": ("one",)}),
        ("spec", "", {"observation_features": FEATURES[:3]}),
        ("spec", "", {"observation_features": (*FEATURES[:3], FEATURES[0])}),
    ],
)
def test_a_violation_is_caught(check: str, change: str, spec: dict[str, Any]) -> None:
    def make(copies: int) -> Broken:
        return Broken(copies, change, spec)

    with pytest.raises(AssertionError):
        CHECKS[check](make, play(make))


class Pickled(Visitors):
    """Snapshots that can be pickled but not stored in a checkpoint."""

    def snapshot(self) -> Any:  # noqa: ANN401 - the contract's type
        return {"kept": super().snapshot(), "days": {1, 2}}

    def restore(self, snapshot: Any) -> Observations:  # noqa: ANN401 - the contract's type
        return super().restore(snapshot["kept"])


def test_a_snapshot_that_checkpoints_cannot_store_is_caught() -> None:
    def make(copies: int) -> Pickled:
        return Pickled(VisitorsConfig(), copies)

    with pytest.raises(AssertionError, match=r"cannot hold the snapshot: .*\['days'\] is a set"):
        CHECKS["snapshots"](make, play(make))


def test_missing_declared_masks_are_caught() -> None:
    with pytest.raises(AssertionError, match="does not declare"):
        play(lambda copies: Broken(copies, "", {"has_action_mask": False}))


class Overruling(Visitors):
    """Overwrites the actions passed to `step`."""

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        actions[0] = 1 - actions[0].clip(0, 1)
        return super().step(actions)


def test_changing_actions_in_place_is_caught() -> None:
    with pytest.raises(AssertionError, match="step must not write to the actions it is given"):
        play(lambda copies: Overruling(VisitorsConfig(), copies))


def test_nan_in_a_live_row_is_caught_while_playing() -> None:
    with pytest.raises(HeadwayError, match=r"visitors .* of agent visitor_\d in copy 1 at step 4"):
        play(lambda copies: Broken(copies, "spoil step 4", {}))


@pytest.mark.parametrize("check", CHECKS)
def test_checks_create_no_environment_to_query_the_copy_limit(check: str) -> None:
    """Starting a simulator takes seconds. A recording of fewer copies can be checked as well."""
    started: list[int] = []

    def make(copies: int) -> Visitors:
        started.append(copies)
        return Visitors(VisitorsConfig(), copies)

    recording = play(make, copies=2)
    started.clear()
    CHECKS[check](make, recording)
    assert started == {"spec": [2], "determinism": [2], "copies": [1, 1], "snapshots": [2, 2]}.get(check, [])
