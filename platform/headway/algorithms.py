"""Choice of an algorithm's entry and configuration record by the configuration keys `algo.*`."""

from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from typing import Any

from headway.config.schema import build, literal_choices
from headway.contracts import AlgoEntry, HeadwayError
from headway.registry import algo_entries, algo_entry


def chosen_algo(mapping: Mapping[str, Any]) -> tuple[AlgoEntry, Any]:
    """Return the entry and the config record of the mapping `algo`.

    Raises HeadwayError if it is not valid.
    """
    hyper_parameters = dict(mapping)
    name = hyper_parameters.pop("name", None)
    if not isinstance(name, str):
        raise HeadwayError(f"algo.name is missing; choose one of {', '.join(algo_entries())}")
    entry = algo_entry(name)
    record = entry.record_for(hyper_parameters)
    if any(field.name == "name" for field in fields(record)):
        hyper_parameters["name"] = name
    elsewhere = partial(_key_elsewhere, entry, hyper_parameters)
    return entry, build(record, hyper_parameters, "algo", name, elsewhere)


def _key_elsewhere(algo: AlgoEntry, hyper_parameters: Mapping[str, Any], key: str) -> str | None:
    """Return a remark on where a key exists that the algorithm lacks with these settings; None: it exists
    nowhere.

    The remark names the choices of this algorithm that have the key or, if there are none, other algorithms.
    """

    def has_key(record: type) -> bool:
        return any(field.name == key for field in fields(record))

    owners = [
        f"algo.{choice}={value}"
        for choice, values in literal_choices(algo.record_for(hyper_parameters)).items()
        for value in values
        if has_key(algo.record_for({**hyper_parameters, choice: value}))
    ]
    owners = owners or [name for name, entry in algo_entries().items() if has_key(entry.config)]
    if len(owners) < 2:
        return f"it is one of {owners[0]}" if owners else None
    return f"it is one of {', '.join(owners[:-1])} and {owners[-1]}"
