"""Every registered environment keeps the contract, natively and through its ParallelEnv."""

import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test
from same_game import assert_same_game

from headway.adapters.conformance import CHECKS, Make, play
from headway.adapters.modules import make_batch, module_entry
from headway.adapters.pettingzoo import AdapterOptions, ParallelEnvBatch
from headway.adapters.recording import Recording
from headway_envs.registry import ENTRIES

pytestmark = pytest.mark.slow

WITH_PARALLEL_ENV = [name for name, entry in ENTRIES.items() if entry.parallel_env is not None]
SHORT: dict[str, dict[str, Any]] = {
    "intersection": {"horizon": 400},
    "junctions": {"horizon": 80, "slots": 40},
    "bus_published": {"scenario": "line"},
}
"""Arguments that shorten environments with long episodes or slow preparation."""


def config_of(name: str) -> Any:  # noqa: ANN401 - the entry's record
    if name in ("intersection", "junctions"):
        pytest.importorskip("libsumo", reason="SUMO (headway[sumo]) is not installed")
    return ENTRIES[name].config(**SHORT.get(name, {}))


def native(name: str) -> Make:
    entry = ENTRIES[name]
    return lambda copies: entry.make(entry.prepare(config_of(name)), copies)


def adapted(name: str) -> Make:
    config, parallel_env = config_of(name), ENTRIES[name].parallel_env
    assert parallel_env is not None
    with closing(native(name)(1)) as env:
        shared, limit = env.spec.shared_reward, env.spec.max_copies_per_process
    options = AdapterOptions(shared_reward=shared, max_copies_per_process=limit)
    return lambda copies: ParallelEnvBatch(lambda: parallel_env(config), copies, name, options)


def gymnasium_batch(name: str) -> Make:
    entry = module_entry(f"gymnasium:{name}")
    return partial(make_batch, entry.prepare(entry.config()))


CASES: dict[str, Callable[[], Make]] = {
    **{name: partial(native, name) for name in ENTRIES},
    **{f"{name} adapted": partial(adapted, name) for name in WITH_PARALLEL_ENV},
    **{name: partial(gymnasium_batch, name) for name in ("CartPole-v1", "Pendulum-v1")},
}
RECORDED: dict[str, Recording] = {}


def recorded(case: str) -> Recording:
    if case not in RECORDED:
        RECORDED[case] = play(CASES[case]())
    return RECORDED[case]


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("case", CASES)
def test_keeps_the_contract(case: str, check: str) -> None:
    CHECKS[check](CASES[case](), recorded(case))


@pytest.mark.parametrize("name", WITH_PARALLEL_ENV)
def test_batched_and_parallel_env_give_the_same_episodes(name: str) -> None:
    through = recorded(f"{name} adapted").of_copy(0)
    with closing(native(name)(1)) as env:
        assert_same_game(env, replace(through, spec=env.spec))


@pytest.mark.parametrize("name", WITH_PARALLEL_ENV)
def test_passes_pettingzoos_own_tests(name: str) -> None:
    config, parallel_env = config_of(name), ENTRIES[name].parallel_env
    assert parallel_env is not None
    with warnings.catch_warnings(), closing(native(name)(1)) as env:
        warnings.simplefilter("error")
        with closing(parallel_env(config)) as face:
            parallel_api_test(face, num_cycles=300)
        if env.spec.max_copies_per_process is None:  # it plays two at once
            parallel_seed_test(lambda: parallel_env(config), num_cycles=50)
