"""Pictures of a merge by `headway render`."""

import numpy as np
import pytest
from merging import make
from PIL import ImageColor
from played import repeated

from headway_envs.merge.entry import ENTRIES
from headway_envs.merge.kernel.layout import IDLE
from headway_envs.merge.renderer import CAV, CRASHED, HUMAN, ROAD, MergeRenderer

CAR_PIXELS = 25 * 10
"""Number of pixels of a vehicle, including its edges."""


def count(picture: np.ndarray, colour: str) -> int:
    near = np.abs(picture.astype(int) - ImageColor.getrgb(colour)).max(axis=-1) < 12
    return int(near[40:].sum())  # below the legend


@pytest.mark.parametrize("name", ENTRIES)
def test_every_vehicle_is_drawn_and_crashes_stand_out(name: str) -> None:
    env = make(name, density=1)
    renderer = MergeRenderer(env.prepared)
    first = renderer.render(env, at_end=False)
    episode = env.world.episodes[0]
    cavs, humans = int(episode["cavs"]), int(episode["cars"] - episode["cavs"])
    assert first.dtype == np.uint8
    assert 0.6 < count(first, CAV) / (cavs * CAR_PIXELS) <= 1
    assert 0.6 < count(first, HUMAN) / (humans * CAR_PIXELS) <= 1
    assert count(first, CRASHED) == 0
    while not repeated(env, IDLE, 1).episode_ended[0]:
        pass
    last = renderer.render(env, at_end=True)
    assert last.shape == first.shape
    assert count(last, CRASHED) > 0.6 * CAR_PIXELS
    assert count(renderer.render(env, at_end=False), CRASHED) == 0


@pytest.mark.parametrize("name", ENTRIES)
def test_the_lanes_carry_no_names(name: str) -> None:
    renderer = MergeRenderer(make(name).prepared)
    pixels = np.asarray(renderer._background)
    for lane in renderer._lanes[renderer._lanes["x"] == 0.0]:
        x, y = (int(pixel) for pixel in renderer._at(40.0, float(lane["y"])))
        assert (pixels[y - 10 : y + 10, : x + 200] == ImageColor.getrgb(ROAD)).all()


def test_the_end_can_be_drawn_after_a_reset() -> None:
    """The adapter of a ParallelEnv resets within its step."""
    env = make(steps=4)
    renderer = MergeRenderer(env.prepared)
    repeated(env, IDLE, 4)
    last = renderer.render(env, at_end=True)
    env.reset(np.ones(1, np.uint64))
    assert count(last, CAV) > 0.6 * CAR_PIXELS
    np.testing.assert_array_equal(renderer.render(env, at_end=True), last)
