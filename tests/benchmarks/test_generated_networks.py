"""The networks of the study of one policy on several, and its tables."""

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import REPORTS, main
from benchmarks.generated_networks import GENERATE, RULES, TRIPS, generate, print_table

GUIDE = Path(__file__).parents[2] / "docs" / "howto" / "sumo_network.md"


def test_the_guide_generates_the_same_networks() -> None:
    page = " ".join(GUIDE.read_text(encoding="utf-8").replace("\\\n", "").split())
    assert f"netgenerate {' '.join(GENERATE)} --seed" in page
    assert f"{' '.join(TRIPS)} --seed" in page


def test_without_sumo_s_programs_one_line_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "sumo", None)
    monkeypatch.setitem(REPORTS, "generated_networks", lambda: generate(1, tmp_path))
    monkeypatch.setattr(sys, "argv", ["benchmarks", "generated_networks"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert capsys.readouterr().err.endswith("missing: install the package eclipse-sumo\n")


def test_a_seed_gives_a_network_with_junctions_and_traffic(tmp_path: Path) -> None:
    pytest.importorskip("sumo", reason="netgenerate (package eclipse-sumo) is not installed")
    pytest.importorskip("libsumo", reason="SUMO (headway[sumo]) is not installed")
    from headway_envs.junctions.config import JunctionsConfig
    from headway_envs.junctions.prepared import prepare

    sizes = []
    for number in (1, 2):
        generate(number, tmp_path)
        files = {"network": f"{tmp_path}/{number}.net.xml", "demand": f"{tmp_path}/{number}.rou.xml"}
        network = prepare(JunctionsConfig(approaches=4, **files)).network
        sizes.append(len(network.signals))
    assert sizes[0] != sizes[1]
    assert min(sizes) >= 5


def test_the_table_ends_with_the_mean_of_the_other_networks_and_its_difference_from_human(
    capsys: pytest.CaptureFixture[str],
) -> None:
    means = np.zeros((3, 1 + len(RULES)))
    means[:, 0], means[1:, 1] = (9, 1, 5), (2, 4)
    print_table(means, 1)
    *_, mean, difference = (line.split(" | ") for line in capsys.readouterr().out.splitlines())
    assert mean[:3] == ["| mean of 2 to 3", "3.0", "3.0"]
    assert difference[1] == "+0.0 [-12.7, 12.7]"
    assert difference[2] == ""
