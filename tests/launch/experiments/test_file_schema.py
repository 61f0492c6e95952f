"""The JSON Schema of files in `configs/`, held to those files and to what the commands accept."""

import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_lines import output, refused
from jsonschema import Draft7Validator

from headway_launch.experiments.compose import compose
from headway_launch.experiments.file_schema import FILE_KINDS, file_schema
from headway_launch.experiments.parameters import full_mapping

ROOT = Path(__file__).resolve().parents[3]
FILES = [(kind, file) for kind in FILE_KINDS for file in sorted((ROOT / "configs" / kind).glob("*.yaml"))]
EXPERIMENTS = [file.stem for kind, file in FILES if kind == "experiment"]


@cache
def validator(kind: str) -> Draft7Validator:
    schema = json.loads(json.dumps(file_schema(kind), allow_nan=False))
    Draft7Validator.check_schema(schema)
    return Draft7Validator(schema)


def accepts(text: str) -> bool:
    return bool(validator("experiment").is_valid(yaml.safe_load(text)))


def misspelt(content: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401 - any YAML
    """Yield every key of nested mappings, and the content with this key misspelt."""
    for key, value in content.items() if isinstance(content, dict) else ():
        yield key, {(f"{key}_" if name == key else name): inner for name, inner in content.items()}
        for below, changed in misspelt(value):
            yield f"{key}.{below}", {**content, key: changed}


@pytest.mark.parametrize(("kind", "file"), FILES, ids=lambda each: getattr(each, "stem", each))
def test_every_file_of_configs_is_accepted(kind: str, file: Path) -> None:
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    assert [error.message for error in validator(kind).iter_errors(content)] == []


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_misspelt_key_of_an_experiment_is_refused(name: str) -> None:
    text = (ROOT / "configs" / "experiment" / f"{name}.yaml").read_text(encoding="utf-8")
    variants = dict(misspelt(yaml.safe_load(text)))
    assert len(variants) > 2
    accepted = [key for key, changed in variants.items() if validator("experiment").is_valid(changed)]
    # Without a registered environment in the file, its arguments are unknown.
    assert [key for key in accepted if "override /env" in text or not key.startswith("env.args.")] == []


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_what_a_run_stores_is_accepted(name: str) -> None:
    stored = full_mapping(compose([f"experiment={name}"]), [0])
    assert [error.message for error in validator("experiment").iter_errors(stored)] == []


def test_the_examples_of_the_guide_are_accepted() -> None:
    page = (ROOT / "docs" / "howto" / "files.md").read_text(encoding="utf-8")
    examples = re.findall(r"^```yaml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert len(examples) == 2
    assert all(map(accepts, examples))


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("experiment", "{env: bsu, algo: mappo}"),
        ("experiment", "{env: bus, algo: mapo}"),
        ("experiment", "{env: bus, preset: bus_tunde}"),
        ("experiment", "{defaults: [{override /alog: mappo}]}"),
        ("experiment", "{defaults: [{override /algo: mapo}]}"),
        ("experiment", "{env: {id: trivial, training_args: {horizn: 5}}}"),
        ("experiment", "{algo: {name: mappo, kl_bound: 0.1}}"),  # a key of other algorithms
        ("experiment", "{algo: {name: mappo, model: {core: lstm}}}"),
        ("experiment", "{algo: {name: mappo, critic: local}}"),
        ("experiment", "{env_steps: many}"),
        ("experiment", "{evaluation: {every: [1]}}"),
        ("experiment", "{energy: {enabled: maybe}}"),
        ("env", "{id: trivial, args: {horizn: 5}}"),
        ("preset", "{mapo: {algo: {lr: 1e-3}}}"),
        ("preset", "{mappo: {algo: {kl_bound: 0.1}}}"),
        ("preset", "{mappo: {rollout: {stesp: 8}}}"),
        ("search", "{bases: []}"),
        ("search", "{sampler: tep}"),
        ("space", "{algorithms: ippo}"),
    ],
)
def test_other_mistakes_are_refused(kind: str, text: str) -> None:
    assert not validator(kind).is_valid(yaml.safe_load(text))


@pytest.mark.parametrize(
    "text",
    [
        "{env: ./shuttle.py, algo: mappo, energy: off}",
        "{env: {id: 'gymnasium:CartPole-v1', args: {anything: 1}}}",
        "{algo: {name: custom, update: trpo, kl_bound: 3e-2}}",
        "{algo: {name: mappo, critic_update: kfac, kfac_decay: 0.9}}",
        "{algo: {lr: 3e-4}, env_steps: 1e6, seed: 0..4}",
        "{env_steps: '${rollout.steps}'}",
    ],
)
def test_forms_that_commands_accept_are_accepted(text: str) -> None:
    assert accepts(text)


def test_keys_have_types_choices_defaults_and_descriptions() -> None:
    schema = file_schema("experiment")
    every = schema["properties"]["evaluation"]["properties"]["every"]
    assert every["default"] == 40_000
    assert "integer" in every["type"]
    assert every["description"].startswith("Environment steps between evaluations")
    lr = {name: schema["definitions"][f"algo.{name}"]["properties"]["lr"] for name in ("mappo", "madqn")}
    assert lr["mappo"]["default"] == compose(["env=trivial", "algo=mappo"]).algo_config.lr
    model = schema["definitions"]["algo.mappo"]["properties"]["model"]["properties"]
    assert model["core"]["enum"] == ["none", "gru"]


def test_the_users_files_are_known(tmp_path: Path) -> None:
    for name, text in {"env/small": "{id: trivial}", "preset/mine": "{mappo: {}}"}.items():
        file = tmp_path / f"{name}.yaml"
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
    schema = Draft7Validator(json.loads(output("list", "schema", "--config-dir", str(tmp_path)).out))
    mine = {"defaults": [{"override /env": "small"}], "preset": "mine", "env": {"args": {"agents": 2}}}
    assert schema.is_valid(mine)
    assert not schema.is_valid({**mine, "env": {"args": {"agenst": 2}}})
    (tmp_path / "env" / "small.yaml").write_text("{id: trivial")
    assert "small.yaml is not valid YAML" in refused("list", "schema", "--config-dir", str(tmp_path))


def test_the_command_prints_it_and_refuses_other_kinds() -> None:
    assert json.loads(output("list", "schema").out)["title"] == "Headway: experiment"
    assert refused("list", "schema", "presets").startswith(
        "headway: there is no schema of 'presets'; did you mean preset?"
    )
