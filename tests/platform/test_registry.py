"""Environments that other packages add by entry point."""

from collections.abc import Callable, Iterator

import pytest

from headway.contracts import HeadwayError
from headway.registry import env_entries, rule_entry, rule_names
from headway.wrappers.wrapped_env import wrapped_entry

PACKAGE = """
from headway.contracts import EnvEntry, RuleEntry
from headway_envs.toy.entry import ENTRIES as TOYS

TOY = TOYS["matrix"]
ENTRIES = {"mine": EnvEntry("a game", TOY.config, TOY.make, rules={"first": RULE})}
"""


@pytest.fixture(autouse=True)
def _not_kept() -> Iterator[None]:
    env_entries.cache_clear()
    yield
    env_entries.cache_clear()


def test_another_package_s_environment_has_the_rule_random(install: Callable[[str, str, str], None]) -> None:
    entry = 'RuleEntry("plays first", TOY.rules["random"].make)'
    install("package_of_games", PACKAGE.replace("RULE})", f"{entry}}})"), "headway.envs")
    assert list(env_entries()["mine"].rules) == ["random", "first"]


def test_a_rule_without_a_summary_is_one_line(install: Callable[[str, str, str], None]) -> None:
    install("package_of_bare_rules", PACKAGE.replace("RULE})", "lambda prepared: None})"), "headway.envs")
    line = r"of package package_of_bare_rules cannot be loaded \(TypeError: rule 'first' must be a RuleEntry"
    with pytest.raises(HeadwayError, match=line):
        env_entries()


def test_lookahead_is_a_rule_but_none_that_is_played_by_default() -> None:
    bus, tracking = env_entries()["bus"], env_entries()["tracking"]
    assert "lookahead" not in bus.rules
    assert rule_names(bus)[-1] == "lookahead"
    assert "lookahead" not in rule_names(tracking)
    assert rule_entry(bus, "even_headway").summary == bus.rules["even_headway"].summary
    assert rule_entry(bus, "lookahead").summary == rule_entry(bus, "lookahead:even_headway:30:8").summary
    assert "in 8 simulations of 5 steps of always_move" in rule_entry(bus, "lookahead:always_move:5").summary


@pytest.mark.parametrize(
    ("env", "name", "line"),
    [
        ("bus", "lookahed", "unknown rule 'lookahed'; did you mean lookahead?"),
        (
            "bus",
            "lookahead:even",
            "lookahead:even: 'even' is not a rule to improve on; did you mean even_headway?",
        ),
        ("bus", "lookahead:lookahead", "lookahead:lookahead: 'lookahead' is not a rule to improve on"),
        ("bus", "lookahead:random:9", "lookahead:random:9: 'random' is not a rule to improve on; available"),
        (
            "bus",
            "lookahead:even_headway:0",
            "with whole numbers of steps and samples from 1 on, such as look",
        ),
        ("bus", "lookahead:even_headway:9:-1", "must have the form lookahead:RULE:STEPS:SAMPLES"),
        ("bus", "lookahead:even_headway:9:", "must have the form"),
        ("bus", "lookahead:even_headway:9:4:1", "must have the form"),
        (
            "tracking",
            "lookahead",
            "needs an environment that can be simulated ahead, without wrappers other than reward wrappers",
        ),
    ],
)
def test_a_lookahead_that_cannot_be_is_one_line(env: str, name: str, line: str) -> None:
    with pytest.raises(HeadwayError) as caught:
        rule_entry(env_entries()[env], name)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_lookahead_does_not_improve_on_random_play_behind_reward_wrappers() -> None:
    entry = wrapped_entry("bus", env_entries()["bus"], [])
    assert "even_headway" in rule_entry(entry, "lookahead:even_headway").summary
    with pytest.raises(HeadwayError, match="'random' is not a rule to improve on"):
        rule_entry(entry, "lookahead:random")
