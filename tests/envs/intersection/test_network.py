"""The packaged network equals netconvert's, and is read as SUMO reads it."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from headway_envs.intersection.network import LINKS, Network, build, network_file

JUNCTIONS = ("priority", "right_before_left", "allway_stop")


def _content(path: Path) -> str:
    """Return the content without the comment, which holds a date and options."""
    return ElementTree.canonicalize(
        re.sub(r"<!--.*?-->", "", path.read_text(), flags=re.DOTALL), strip_text=True
    )


@pytest.mark.parametrize("junction", JUNCTIONS)
def test_the_packaged_network_equals_netconverts(junction: str, tmp_path: Path) -> None:
    sumo = pytest.importorskip("sumo", reason="netconvert (package eclipse-sumo) is not installed")
    made = build(str(Path(sumo.SUMO_HOME, "bin", "netconvert")), junction, tmp_path)
    assert _content(made) == _content(network_file(junction))


@pytest.mark.parametrize("junction", JUNCTIONS)
def test_conflicts_are_symmetric_and_have_a_right_of_way(junction: str) -> None:
    network = Network.read(network_file(junction))
    np.testing.assert_array_equal(network.foes, network.foes.T)
    assert not (network.yields & ~network.foes).any()
    assert not (network.foes & ~(network.yields | network.yields.T)).any()
    by_turn = network.link_length.reshape(4, 4)
    np.testing.assert_allclose(by_turn, np.tile([9.03, 20.8, 20.8, 19.35], (4, 1)), atol=0.01)
    straight = [4 * approach + LINKS.index(("straight", 0)) for approach in range(4)]
    assert network.foes[straight[0], [straight[1], straight[3]]].all()
    assert not network.foes[straight[0], straight[2]]
    # If a road has priority, it is the north-south one, whose straight paths never yield.
    yielding = [False, True, False, True] if junction == "priority" else [True] * 4
    assert network.yields[straight].any(axis=1).tolist() == yielding


def test_positions_lie_on_the_path() -> None:
    network = Network.read(network_file("priority"))
    from_north = LINKS.index(("straight", 0))
    assert network.place(from_north, 0.0) == pytest.approx((-4.8, 200.0))
    assert network.place(from_north, 200.0) == pytest.approx((-4.8, 10.4))
    assert network.place(from_north, 200.0 + 20.8 + 200.0) == pytest.approx((-4.8, -200.0))
    assert network.place(LINKS.index(("left", 1)), 420.0)[0] == pytest.approx(200.0, abs=1.0)
