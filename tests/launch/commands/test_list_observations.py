"""`headway list observations`: the numbers of an observation as the environment and its wrappers say."""

from contextlib import closing

import numpy as np
import pytest
from command_lines import refused, rows_of

from headway_launch.experiments.compose import compose


def test_index_name_unit_scale_and_meaning_are_listed() -> None:
    header, *rows = rows_of("list", "observations", "merge_two_lane")
    assert header == ["index", "name", "unit", "scale", "meaning"]
    assert [row[0] for row in rows] == [str(index) for index in range(25)]
    assert rows[1] == ["1", "x", "m", "150", "position along the highway"]


def test_arguments_and_wrappers_count() -> None:
    rows = rows_of("list", "observations", "bus", "env.args.observation=paper", "env.args.capacity=60")[1:]
    assert [row[:4] for row in rows] == [
        ["0", "running_time", "s", "300"],
        ["1", "expected_boardings", "passengers", "20"],
        ["2", "load", "passengers", "60"],
        ["3", "uptime", "", "1"],
    ]
    wrappers = "env.wrappers=[agent_indicator_v0,{name:frame_stack_v1,stack_size:2}]"
    names = [row[1] for row in rows_of("list", "observations", "matrix", wrappers)[1:]]
    frame = ("row", "column", "is_row", "is_column")
    assert names == [f"{name}{time}" for time in ("[t-1]", "[t]") for name in frame]


def test_an_agent_s_indicator_times_its_scale_is_one() -> None:
    """Its number is the highest upper bound of the observations, which is not 1 here."""
    words = ("env=bus", "env.args.observation=control", "env.wrappers=[agent_indicator_v0]")
    found = compose(words).prepare()
    with closing(found.entry.make(found.prepared, 1)) as env:
        observations = env.reset([7]).observations[0]
        spec = env.spec
    features = spec.observation_features[-spec.num_agents :]
    indicators = observations[:, -spec.num_agents :]
    assert set(np.unique(indicators)) == {0.0, 5.0}
    np.testing.assert_allclose(indicators * [each.scale for each in features], np.eye(spec.num_agents))
    assert [each.meaning for each in features] == [f"1 for {agent}, else 0" for agent in spec.agents]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "name an environment, such as `headway list observations bus`"),
        (("buss",), "did you mean env=bus?"),
        (("bus", "observation=paper"), "did you mean env.args.observation=paper?"),
        (("bus", "env.args.observation=papers"), "observation"),
        (("mpe2.simple_spread_v3",), "does not describe the 18 numbers of its observations"),
        (("tracking", "env.wrappers=[normalize_obs_v0]"), "normalize_obs_v0 needs finite bounds"),
        (("trivial", "env.wrappers=[normalize_obs_v0]"), "does not describe the 4 numbers"),
    ],
)
def test_what_cannot_be_listed_is_one_line(words: tuple[str, ...], says: str) -> None:
    assert says in refused("list", "observations", *words)


def test_other_lists_take_no_keys() -> None:
    assert "headway list envs takes one name: leave out env.args.capacity=60" in refused(
        "list", "envs", "bus", "env.args.capacity=60"
    )
