"""Comparison of retrained with archived runs, and the draw of runs."""

from hashlib import sha256
from pathlib import Path
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from headway.contracts import HeadwayError
from headway.store.parquet_log import RunLog
from headway_launch.studies.verification import _compared, _within_spread, differences, drawn

RETURN = "evaluation_greedy/return"


def keep(folder: Path, values: list[float]) -> Path:
    """Store a run whose curve has these returns, at 10, 20 ... steps, in a segment per point."""
    log = RunLog(folder)
    for place, value in enumerate(values, start=1):
        at = {"iteration": place, "env_steps": 10 * place}
        log.append("curve", [{**at, "wall_s": perf_counter(), "policy/entropy": 0.25, RETURN: value}])
        log.append("evaluation", [{**at, "mode": "greedy", "episode_seed": 0, "return": value}])
        log.commit(place)
    return folder


def test_runs_are_drawn_by_a_hash_that_anyone_can_compute() -> None:
    rows: Any = [SimpleNamespace(run_id=f"run-{number}") for number in range(20)]
    digests = {row.run_id: sha256(f"7:{row.run_id}".encode()).hexdigest() for row in rows}
    expected = sorted(digests, key=digests.__getitem__)[:3]
    assert [row.run_id for row in drawn(rows[::-1], 3, 7)] == expected
    assert {row.run_id for row in drawn(rows, 3, 8)} != set(expected)
    with pytest.raises(HeadwayError, match="--runs 21: the archive holds 20 finished runs"):
        drawn(rows, 21, 7)


def test_the_first_difference_is_found_in_the_last_bit(tmp_path: Path) -> None:
    values = [1.0, 2.0, 0.1, 4.0]
    archived = keep(tmp_path / "a", values)
    assert _compared(archived, keep(tmp_path / "b", values), 4) == (4 * (4 + 5), None)
    values[2] = float(np.nextafter(0.1, 1))
    other = keep(tmp_path / "c", values)
    assert _compared(archived, other, 2) == (2 * (4 + 5), None)
    _, first = _compared(archived, other, 4)
    assert first == f"from step 30 on: curve {RETURN} 0.10000000000000002, archived 0.1"
    assert _compared(archived, keep(tmp_path / "d", values[:2]), 2) == (2 * (4 + 5), None)
    _, first = _compared(archived, keep(tmp_path / "e", values[:3]), 4)
    assert "rows, archived 4" in str(first)


@pytest.mark.parametrize(("value", "equal"), [(3.0, True), (30.0, False)])
def test_elsewhere_the_score_lies_where_a_further_seed_would(
    value: float, equal: bool, tmp_path: Path
) -> None:
    scores = [1.0, 2.5, 3.0, 4.0]
    rows: Any = [
        SimpleNamespace(directory=str(keep(tmp_path / str(seed), [0.0, score, 99.0])))
        for seed, score in enumerate(scores)
    ]
    again = keep(tmp_path / "again", [0.0, value])
    found, text = _within_spread(tmp_path / "0", again, rows, RETURN, 20)
    width = stats.sem(scores) * np.sqrt(len(scores) + 1)
    low, high = stats.t.interval(0.99, len(scores) - 1, loc=np.mean(scores), scale=width)
    assert found is equal
    assert bool(low <= value <= high) is equal
    assert text.endswith(f"archived 1; 99% of further seeds lie in {low:.6g} to {high:.6g}")


def test_only_what_decides_the_last_bits_counts() -> None:
    there = {
        "version.numpy": "2.0", "version.numba": "0.6", "version.codecarbon": "3", "version.libsumo": "1",
        "hardware.cpu": "A", "hardware.cpu_features": "avx avx2", "hardware.cores": "2",
        "hardware.system": "Linux-6.1-x86_64-with-glibc2.36", "git.revision": "abc",
    }  # fmt: skip
    here = {**there, "version.codecarbon": "4", "hardware.cores": "64", "git.revision": "def"}
    here["hardware.system"] = "Linux-6.9-other-x86_64-with-glibc2.36"
    del here["version.libsumo"]
    assert list(differences(there, here)) == []
    assert list(differences({**there, "version.numpy": "2.1"}, here)) == ["version.numpy 2.1 there, 2.0 here"]
    features = {**here, "hardware.cpu_features": "avx avx2 avx512f"}
    assert list(differences(there, features)) == ["hardware.cpu_features none more there, avx512f here"]
    library = {**here, "hardware.system": "Linux-6.1-x86_64-with-glibc2.41"}
    assert list(differences(there, library)) == ["hardware.system glibc2.36 there, glibc2.41 here"]
    assert list(differences({}, {"version.numba": "0.6"})) == ["version.numba unknown there, 0.6 here"]
    assert list(differences(there, {**here, "hardware.gpu": "B"})) == ["hardware.gpu unknown there, B here"]
