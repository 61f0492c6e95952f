"""The registry is light, and what reads the arrays of its own environments refuses others in one line."""

import subprocess
import sys

import pytest

from headway_envs.registry import ENTRIES


def test_importing_the_registry_imports_nothing_heavy() -> None:
    heavy = ("numba", "pandas", "pettingzoo", "gymnasium", "torch", "supersuit", "mlflow")
    program = (
        "import sys, headway_envs.registry as e; assert e.ENTRIES; "
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("name", [name for name, entry in ENTRIES.items() if entry.renderer is not None])
def test_a_renderer_refuses_another_environment(name: str) -> None:
    if name in ("intersection", "junctions"):
        pytest.importorskip("libsumo", reason="SUMO (headway[sumo]) is not installed")
    entry = ENTRIES[name]
    assert entry.renderer is not None
    renderer = entry.renderer(entry.prepare(entry.config()))
    with pytest.raises(TypeError, match=r"the picture of an? .+ needs an? \w+BatchedEnv, not object"):
        renderer.render(object(), at_end=False)


@pytest.mark.parametrize(("name", "rule"), [("merge", "idm_mobil"), ("bus_published", "move_with_service")])
def test_a_rule_refuses_another_environment(name: str, rule: str) -> None:
    with pytest.raises(TypeError, match=rf"{rule} needs a \w+BatchedEnv, not object"):
        ENTRIES[name].rules[rule].make(None).act(object(), None)
