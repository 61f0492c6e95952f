"""Pictures of scenarios."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from headway.contracts import HeadwayError
from headway_envs.bus.scenario.drawing import draw_scenario
from headway_envs.bus.scenario.synthetic import generate


@pytest.mark.parametrize("scenario", ["line", "district"])
def test_a_picture_shows_the_map_and_the_day(scenario: str, tmp_path: Path) -> None:
    tables = generate(scenario, 0)
    draw_scenario(tables, "weekday", scenario, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    left = pixels[:, : pixels.shape[1] * 55 // 100]
    coloured = (left.max(axis=2) - left.min(axis=2) > 60).mean()
    assert coloured > 0.002  # links, not only black text on white
    draw_scenario(tables, "sunday", scenario, tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() != (tmp_path / "b.png").read_bytes()


def test_a_day_without_trips_and_a_strange_file_are_one_line(tmp_path: Path) -> None:
    tables = generate("line", 0)
    weekday = replace(tables, trips=tables.trips[tables.trips["daytype"] == "weekday"])
    with pytest.raises(HeadwayError, match="there is no trip on a sunday"):
        draw_scenario(weekday, "sunday", "", tmp_path / "a.png")
    with pytest.raises(HeadwayError, match="cannot be written"):
        draw_scenario(tables, "weekday", "", tmp_path / "none" / "a.png")
