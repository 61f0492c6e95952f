"""`headway list keys`: every key of an experiment with its default and meaning."""

import pytest
from command_lines import refused, rows_of

from headway.registry import algo_entries, env_entries
from headway_launch.commands.listing import KINDS
from headway_launch.experiments.compose import compose


def test_without_a_kind_the_kinds_are_listed() -> None:
    header, *rows = rows_of("list")
    assert header == ["kind", "what is listed"]
    assert [kind for kind, _ in rows] == list(KINDS)
    assert all(text for _, text in rows)


def test_a_word_finds_keys_of_all_kinds() -> None:
    header, *rows = rows_of("list", "keys", "lr")
    assert header == ["key", "type", "default", "of", "description"]
    shown = {
        (name, key): float(default)
        for key, _, default, of, _ in rows
        if key in ("algo.lr", "algo.lr_end")
        for name in of.split(", ")
    }
    for name in algo_entries():
        config = compose(["env=tracking" if name == "ddpg" else "env=trivial", f"algo={name}"]).algo_config
        assert shown[name, "algo.lr"] == config.lr
        assert shown[name, "algo.lr_end"] == config.lr_end
    found = rows_of("list", "keys", "SCENARIO_SEED")[1:]
    assert {key for key, *_ in found} == {"env.args.scenario_seed"}
    assert "bus" in {name for row in found for name in row[3].split(", ")}


@pytest.mark.parametrize("group", ["algo", "env", "rollout", "backend", "store", "evaluation", "energy"])
def test_every_group_is_listed(group: str) -> None:
    keys = [row[0] for row in rows_of("list", "keys")[1:]]
    assert sum(key.startswith(f"{group}.") for key in keys) > 2
    rows = rows_of("list", "keys", "env.args.")[1:]
    assert set(env_entries()) <= {name for row in rows for name in row[3].split(", ")}


def test_a_word_of_no_name_is_looked_for_in_descriptions() -> None:
    rows = rows_of("list", "keys", "MLflow")[1:]
    assert rows
    assert all("mlflow" in row[4].lower() for row in rows)
    assert refused("list", "keys", "evalutaion.seed").startswith(
        "headway: no key contains 'evalutaion.seed'; did you mean evaluation.seed?"
    )
    line = refused("list", "keys", "zzzz")
    assert line == "headway: no key contains 'zzzz'; `headway list keys` lists all\n"
