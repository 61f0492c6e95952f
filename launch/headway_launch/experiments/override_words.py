"""Overrides in Hydra's grammar: checked, and written from Python values."""

import re
from collections.abc import Mapping, Sequence

from headway.contracts.errors import HeadwayError
from headway_launch.experiments.options import options

_WORD = re.compile(r"[A-Za-z_][\w.]*", re.ASCII)
"""Pattern of text that needs no quotes."""
_BEFORE_QUOTE = re.compile(r'(\\*)("|$)')


def replaced_words(words: Sequence[str]) -> list[tuple[str, str]]:
    """Return pairs of a word KEY=VALUE and the later word that replaces it with another value."""
    given: dict[str, str] = {}
    replaced = []
    for word in words:
        key, equals, _ = word.partition("=")
        key = key.strip("+ ")
        if equals and given.get(key, word) != word:
            replaced.append((given[key], word))
        given[key] = word
    return replaced


def require_each_key_once(words: Sequence[str]) -> None:
    """Raise HeadwayError if a key has two values."""
    for first, last in replaced_words(words):
        raise HeadwayError(f"{first} and {last} set the same key; omit one of them")


def override_words(keys: Mapping[str, object], sweep: bool = False) -> list[str]:
    """Return `KEY=VALUE` for each key with its Python value.

    `sweep`: each item of a list or tuple is a value that makes a cell; for `seed`, items are always seeds.
    Text for `seed` and for groups, such as `algo`, stays as on the command line. Raises HeadwayError for a
    value that a configuration cannot hold.
    """
    as_given = {"seed", *options()}
    words = []
    for key, value in keys.items():
        if isinstance(value, str) and key in as_given:
            words.append(f"{key}={value}")
        elif sweep and key == "study" and isinstance(value, list | tuple) and len(value) > 1:
            raise HeadwayError(f"study={list(value)}: a sweep has one study; give one name")
        elif sweep and key != "seed" and isinstance(value, list | tuple | range):
            listed = ",".join(
                each if isinstance(each, str) and key in as_given else _checked(key, each) for each in value
            )
            words.append(f"{key}={listed if len(value) == 1 else f'choice({listed})'}")
        else:
            words.append(f"{key}={_checked(key, value)}")
    return words


def written(value: object) -> str:
    """Return a value in Hydra's grammar; numpy's numbers and arrays as Python's.

    Raises TypeError for anything but None, numbers, text, lists and mappings.
    """
    if hasattr(value, "tolist"):
        value = value.tolist()
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{written(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, str):
        plain = _WORD.fullmatch(value) and value.lower() not in ("null", "true", "false", "nan", "inf")
        return value if plain else _quoted(value)
    if isinstance(value, list | tuple | range):
        return "[" + ",".join(map(written, value)) + "]"
    if isinstance(value, int | float):
        return repr(value)
    raise TypeError(type(value).__name__)


def _quoted(text: str) -> str:
    """Return text in double quotes: a backslash counts only before a quote and before an interpolation."""
    inner = text.replace("${", "\\${")
    return '"' + _BEFORE_QUOTE.sub(lambda found: 2 * found[1] + ("\\" + '"' if found[2] else ""), inner) + '"'


def _checked(key: str, value: object) -> str:
    try:
        return written(value)
    except TypeError as error:
        raise HeadwayError(
            f"{key} cannot be a {error}; give None, a number, text, or a list or mapping of these"
        ) from error
