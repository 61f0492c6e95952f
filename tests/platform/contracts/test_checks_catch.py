"""Each check of the contract fails for an environment that violates it."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.adapters.conformance import CHECKS, play
from headway.contracts import EnvSpec, HeadwayError, ObservationFeature, Observations, StepResult
from headway_envs.toy.visitors import Visitors, VisitorsConfig

Change = Callable[[StepResult, Observations, int], None]
FEATURES = tuple(ObservationFeature(f"x{i}", f"number {i}") for i in range(4))


class Broken(Visitors):
    """Visitors with one violation: `change` modifies the result of each step."""

    def __init__(self, copies: int, change: Change, promises: Mapping[str, Any]) -> None:
        super().__init__(VisitorsConfig(), copies)
        self._change, self._calls = change, 0
        self._promised = dataclasses.replace(super().spec, **promises)

    @property
    def spec(self) -> EnvSpec:
        return self._promised

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        outcome, observed = super().step(actions)
        self._calls += 1
        self._change(outcome, observed, self._calls)
        return outcome, observed


def keep(outcome: StepResult, observed: Observations, call: int) -> None:
    pass


def act_while_away(outcome: StepResult, observed: Observations, call: int) -> None:
    outcome.acting.fill(True)


def set_both(outcome: StepResult, observed: Observations, call: int) -> None:
    outcome.truncated[outcome.episode_ended] = True
    outcome.terminated[outcome.episode_ended] = True


def leave_one_running(outcome: StepResult, observed: Observations, call: int) -> None:
    outcome.terminated[:, 0] = outcome.truncated[:, 0] = False


def allow_nothing(outcome: StepResult, observed: Observations, call: int) -> None:
    assert observed.action_masks is not None
    observed.action_masks[:, :3] = False


def pay_by_call(outcome: StepResult, observed: Observations, call: int) -> None:
    outcome.rewards[:] += call % 11


def pay_by_neighbour(outcome: StepResult, observed: Observations, call: int) -> None:
    outcome.rewards[:] += outcome.rewards[-1].sum()


def pay_the_team_where_it_acted(outcome: StepResult, observed: Observations, call: int) -> None:
    outcome.rewards[:] = outcome.acting


def spoil_metrics(outcome: StepResult, observed: Observations, call: int) -> None:
    outcome.metrics.fill(np.nan)


@pytest.mark.parametrize(
    ("check", "change", "spec"),
    [
        ("alive", act_while_away, {}),
        ("alive", keep, {"agents_come_and_go": False}),
        ("ends", set_both, {}),
        ("ends", leave_one_running, {}),
        ("ends", spoil_metrics, {}),
        ("masks", allow_nothing, {}),
        ("shared reward", keep, {"shared_reward": True}),
        ("shared reward", pay_the_team_where_it_acted, {"shared_reward": True}),
        ("shared reward", keep, {"shared_in_groups": True}),
        ("shared reward", keep, {"shared_in_groups": True, "groups": ("a", "a", "b", "b", "c", "c")}),
        ("determinism", pay_by_call, {}),
        ("copies", pay_by_neighbour, {}),
        ("snapshots", pay_by_call, {}),
        ("snapshots", keep, {"snapshots": False}),
        ("spec", keep, {"groups": ("one",)}),
        ("spec", keep, {"observation_features": FEATURES[:3]}),
        ("spec", keep, {"observation_features": (*FEATURES[:3], FEATURES[0])}),
    ],
)
def test_a_violation_is_caught(check: str, change: Change, spec: dict[str, Any]) -> None:
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
        play(lambda copies: Broken(copies, keep, {"has_action_mask": False}))


class Overruling(Visitors):
    """Overwrites the actions passed to `step`."""

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        actions[0] = 1 - actions[0].clip(0, 1)
        return super().step(actions)


def test_changing_actions_in_place_is_caught() -> None:
    with pytest.raises(AssertionError, match="step must not write to the actions it is given"):
        play(lambda copies: Overruling(VisitorsConfig(), copies))


def test_nan_in_a_live_row_is_caught_while_playing() -> None:
    def spoil(outcome: StepResult, observed: Observations, call: int) -> None:
        if call == 4:
            observed.observations[1] = np.nan

    with pytest.raises(HeadwayError, match=r"visitors .* of agent visitor_\d in copy 1 at step 4"):
        play(lambda copies: Broken(copies, spoil, {}))


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
