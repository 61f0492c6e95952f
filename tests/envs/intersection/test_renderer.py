"""Pictures show vehicles and crashes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from headway_envs.intersection.parallel import IntersectionSlotsParallelEnv
from headway_envs.intersection.renderer import CRASH, FAST, HUMAN, Camera, Frame, render

Open = Callable[..., Any]
FULL = np.full((1, 96, 1), 3, np.float32)


def _near(picture: Any, colour: Any) -> int:  # noqa: ANN401 - arrays
    """Return the number of pixels close to a colour."""
    return int((np.abs(picture.astype(int) - np.array(colour)).max(axis=2) < 40).sum())


def _frame(x: float, **changes: Any) -> Frame:  # noqa: ANN401 - any field
    fields = {
        "time_s": 1.0,
        "nose": np.array([[x, 1.6]]),
        "tail": np.array([[x + 5, 1.6]]),
        "speed": np.array([20.0]),
        "automated": np.array([True]),
    }
    return Frame(**{**fields, **changes})


def test_a_vehicle_is_drawn_at_its_position_in_the_colour_of_its_kind() -> None:
    picture = render(_frame(20.0))
    assert picture.shape == (640, 640, 3)
    assert picture.dtype == np.uint8
    rows, columns = np.nonzero(np.abs(picture.astype(int) - FAST).max(axis=2) < 40)
    assert columns.mean() == pytest.approx((80 + 22.5) * 4, abs=2)
    assert rows.mean() == pytest.approx((80 - 1.6) * 4, abs=2)
    assert len(rows) == pytest.approx(5.0 * 1.8 * 16, rel=0.3)
    assert _near(render(_frame(20.0, automated=np.array([False]))), FAST) == 0
    assert _near(render(_frame(20.0, automated=np.array([False]))), HUMAN) > _near(picture, HUMAN) + 50
    assert _near(picture, CRASH) == 0
    assert _near(render(_frame(20.0, crashes=((-9.0, 0.0),))), CRASH) > 50


def test_a_parallel_env_renders_its_environment() -> None:
    face = IntersectionSlotsParallelEnv()
    face.reset(seed=4)
    empty = face.render()
    for _ in range(120):
        face.step(dict.fromkeys(face.agents, np.array([2.0], np.float32)))
    assert (empty != face.render()).any(axis=2).sum() > 200
    face.close()


def test_a_film_marks_a_crash_for_two_seconds(crossing: Open) -> None:
    env = crossing(av_speed_mode=0, hdv_speed_mode=1)
    env.reset(np.array([3], np.uint64))
    camera, marked, crashed = Camera(env), [], []
    for _ in range(500):
        before = env.counters.crashes
        env.step(FULL)
        marked.append(bool(camera.frame().crashes))
        crashed.append(env.counters.crashes > before)
    first = crashed.index(True)
    assert marked.index(True) == first
    assert all(marked[first : first + 20])
    assert sum(marked) <= 21 * sum(crashed)
