"""The peer's program needs what Headway does not install: it says so."""

import sys

import pytest

from headway_launch.trials import spread_peer


def test_without_stable_baselines3_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.setattr(sys, "argv", ["spread_peer", "--seeds", "0"])
    assert spread_peer.main() == 2
    assert "pip install stable-baselines3" in capsys.readouterr().err
