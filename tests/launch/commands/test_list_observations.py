"""`headway list observations`: the numbers of an observation as the environment and its wrappers say."""

import pytest
from command_lines import Refused, RowsOf


def test_index_name_unit_scale_and_meaning_are_listed(rows_of: RowsOf) -> None:
    header, *rows = rows_of("list", "observations", "merge_two_lane")
    assert header == ["index", "name", "unit", "scale", "meaning"]
    assert [row[0] for row in rows] == [str(index) for index in range(25)]
    assert rows[1] == ["1", "x", "m", "150", "position along the highway"]


def test_arguments_and_wrappers_count(rows_of: RowsOf) -> None:
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
def test_what_cannot_be_listed_is_one_line(words: tuple[str, ...], says: str, refused: Refused) -> None:
    assert says in refused("list", "observations", *words)


def test_other_lists_take_no_keys(refused: Refused) -> None:
    assert "headway list envs takes one name: leave out env.args.capacity=60" in refused(
        "list", "envs", "bus", "env.args.capacity=60"
    )
