"""The peer's program names its missing dependency, and takes its settings from the experiment."""

import sys

import numpy as np
import pytest

from tests.trials import spread_peer


def test_without_stable_baselines3_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.setattr(sys, "argv", ["spread_peer", "--seeds", "0"])
    assert spread_peer.main() == 2
    assert "pip install stable-baselines3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--seeds", "0", "-1"], "--seeds must be at least 0, not -1"),
        (["--env-steps", "0"], "--env-steps must be at least 1, not 0"),
        (["--episodes", "-3"], "--episodes must be at least 1, not -3"),
        (["--episodes", "many"], "argument --episodes: invalid int value: 'many'; see --help"),
    ],
)
def test_bad_numbers_are_one_line(
    words: list[str], line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["spread_peer", *words])
    assert spread_peer.main() == 2
    told = capsys.readouterr()
    assert told.err == f"headway: {line}\n"
    assert told.out == ""


def test_the_peer_has_the_settings_of_the_experiment() -> None:
    """The settings behind the results in docs/design/algorithms.md."""
    experiment = spread_peer.spread_experiment()
    assert dict(experiment.config.env.args) == {"N": 3, "max_cycles": 25, "local_ratio": 0.5}
    assert experiment.config.rollout.copies == 20
    assert spread_peer.hyper_parameters(experiment) == {
        "n_steps": 100, "batch_size": 750, "policy_kwargs": {"net_arch": [64, 64]}, "learning_rate": 5e-4,
        "n_epochs": 5, "gamma": 0.99, "gae_lambda": 0.95, "clip_range": 0.2, "ent_coef": 0.01, "vf_coef": 1.0,
        "max_grad_norm": 0.5,
    }  # fmt: skip


def test_only_ends_are_marked_as_time_limits() -> None:
    infos: list[dict[str, object]] = [{"episode": 1}, {}]
    wait = spread_peer._with_time_limits(lambda: ("seen", "paid", [True, False], infos))
    assert wait() == ("seen", "paid", [True, False], infos)
    assert infos == [{"episode": 1, "TimeLimit.truncated": True}, {"TimeLimit.truncated": False}]


def test_ends_are_converted_to_booleans() -> None:
    """Integer flags would index copies 0 and 1."""
    given = np.array([0, 1, 1, 0], dtype=np.uint8)
    _, _, ended, _ = spread_peer._with_boolean_ends(lambda: ("seen", "paid", given, []))()
    returns = np.ones(4)
    returns[ended] = 0
    assert returns.tolist() == [1, 0, 0, 1]
