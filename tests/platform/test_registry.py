"""Environments that other packages add by entry point."""

from collections.abc import Callable, Iterator

import pytest

from headway.contracts import HeadwayError
from headway.registry import env_entries

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
