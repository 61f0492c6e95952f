"""Policies outside the platform against the rollout worker's; what they refuse; copied and damaged files."""

import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from kept_policies import keep_made
from made_observations import AGENTS, SIZE, drawn, repeated, spec_with
from numpy.typing import NDArray

from headway.api import Policy, load_policy
from headway.contracts import (
    ActionSpace,
    Box,
    Discrete,
    HeadwayError,
    MultiDiscrete,
    ObservationFeature,
    Observations,
    RecurrentPolicy,
)
from headway.policies import trained_run
from headway.policies.files import FORMATS, read_policy
from headway.policies.parity import require_parity
from headway.policies.stored_spec import spec_json, spec_of
from headway.policies.trained_run import TrainedRun
from headway_algos.config import ModelConfig

COPIES = 40
GRU = ModelConfig(hidden=(6,), core="gru", gru_size=4)
RELU = ModelConfig(hidden=(8, 7), activation="relu")
BOX = Box((-1.0, -2.0, 0.0), (1.0, 6.0, float("inf")))
BOUNDED = Box((0.0, -2.0), (1.0, 6.0))
KINDS: dict[str, tuple[str, ActionSpace, dict[str, Any]]] = {
    "shared with indices": ("ippo", Discrete(4), {"policies": "shared", "model": ModelConfig(hidden=(8,))}),
    "groups": ("mappo", Discrete(4), {"policies": "groups", "model": RELU, "precision": "float64"}),
    "independent": ("ippo", MultiDiscrete((2, 3, 1)), {"policies": "independent", "model": RELU}),
    "box": ("ippo", BOX, {"policies": "independent"}),
    "not normalised": ("ippo", BOX, {"policies": "groups", "normalise_observations": False}),
    "recurrent": ("ippo", Discrete(3), {"policies": "groups", "model": GRU}),
    "recurrent box": ("ippo", BOX, {"policies": "shared", "model": GRU, "agent_id": False}),
    "values": ("madqn", Discrete(3), {"policies": "shared"}),
    "deterministic": ("ddpg", BOUNDED, {"policies": "independent"}),
}
Kept = tuple[Path, TrainedRun]


def kept(root: Path, kind: str) -> Kept:
    algorithm, space, settings = KINDS[kind]
    folder = keep_made(root, algorithm, spec_with(space), **settings)[0]
    return folder, TrainedRun.read(folder)


def of_worker(run: TrainedRun, seen: Observations, state: NDArray[Any] | None) -> NDArray[Any]:
    """Greedy actions of the rollout worker, in the environment's units and within its bounds."""
    acting, space = run.acting, run.spec.action_space
    if isinstance(acting, RecurrentPolicy) and state is not None:
        actions = acting.act_from(run.parameters, seen, state, None)[0]
    else:
        actions = acting.act(run.parameters, seen, None)[0]
    if not isinstance(space, Box):
        return actions
    low, high = np.array(space.low), np.array(space.high)
    bounded = np.isfinite(high - low)
    with np.errstate(invalid="ignore"):
        scaled = np.where(bounded, (low + high) / 2 + (high - low) / 2 * actions, actions)
    return np.clip(scaled, low, high)


@pytest.mark.parametrize("form", [*FORMATS, "folder"])
@pytest.mark.parametrize("kind", KINDS)
def test_acts_as_the_rollout_worker(kind: str, form: str, tmp_path: Path) -> None:
    """The hidden states, which are passed on, are equal too; `require_parity` compares the distributions."""
    if form == "onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")
    source, run = kept(tmp_path, kind)
    if form != "folder":
        source = tmp_path / f"policy{FORMATS[form].suffix}"
        source.write_bytes(FORMATS[form].contents(run.description, run.arrays))
    policy = load_policy(source) if form == "folder" else read_policy(source)
    space = run.spec.action_space
    seen, state = drawn(space, COPIES), None
    assert (policy.agents, policy.action_space, policy.observation_size) == (run.spec.agents, space, SIZE)
    for _ in range(3):
        before = np.zeros((COPIES, AGENTS, policy.hidden_size), np.float32) if state is None else state
        expected = of_worker(run, seen, before if policy.hidden_size else None)
        require_parity(policy, run.acting, run.parameters, seen, before if policy.hidden_size else None)
        actions, state = policy.act(seen.observations, seen.action_masks, state=state)
        np.testing.assert_allclose(actions, expected, atol=1e-4, rtol=1e-5)
        assert (state is not None) == (policy.hidden_size > 0)
        seen = replace(seen, observations=0.5 * seen.observations)


@pytest.mark.parametrize("name", ["weight_0", "bias_1", "gru_weight_hidden", "gru_bias_hidden"])
def test_a_small_difference_is_found(name: str, tmp_path: Path) -> None:
    _, run = kept(tmp_path, "recurrent")
    arrays = {**run.arrays, name: run.arrays[name] + np.float32(1e-3)}
    (tmp_path / "policy.npz").write_bytes(FORMATS["npz"].contents(run.description, arrays))
    policy, seen = load_policy(tmp_path / "policy.npz"), drawn(run.spec.action_space, COPIES)
    state = np.full((COPIES, AGENTS, 4), 0.3, np.float32)
    with pytest.raises(HeadwayError, match="differs from the rollout workers'"):
        require_parity(policy, run.acting, run.parameters, seen, state)


def test_discrete_actions_are_drawn_from_the_workers_distribution(tmp_path: Path) -> None:
    folder, run = kept(tmp_path, "shared with indices")
    draws = 20_000
    seen = repeated(drawn(run.spec.action_space, 1), draws)
    policy, random = load_policy(folder), np.random.default_rng(5)
    actions, _ = policy.act(seen.observations, seen.action_masks, deterministic=False, generator=random)
    # The worker's probability of an action: that with which it takes it if its inverse is drawn.
    uniforms = np.repeat(np.linspace(0, 1, draws, endpoint=False)[:, None], AGENTS, axis=1)
    expected, log_probs = run.acting.act(run.parameters, seen, uniforms)
    for agent in range(AGENTS):
        for action in range(4):
            taken = expected[:, agent] == action
            probability = np.exp(log_probs[taken, agent][0]) if taken.any() else 0.0
            spread = np.sqrt(probability * (1 - probability) / draws)
            assert abs((actions[:, agent] == action).mean() - probability) <= 4.5 * spread + 1e-4


def test_box_actions_are_drawn_around_the_mean_and_clipped(tmp_path: Path) -> None:
    folder, run = kept(tmp_path, "box")
    policy, draws = load_policy(folder), 20_000
    one = drawn(BOX, 1)
    actions, _ = policy.act(
        repeated(one, draws).observations, deterministic=False, generator=np.random.default_rng(5)
    )
    low, high = np.array(BOX.low), np.array(BOX.high)
    assert (actions >= low).all()
    assert (actions <= high).all()
    # The second component is scaled to [-2, 6]: four times a Gaussian about the mean, shifted by 2.
    mean = run.acting.act(run.parameters, one, None)[0][0, :, 1].astype(float)
    deviation = np.exp(run.parameters["log_std"][:, 1, 0].astype(float))
    around = mean + deviation * np.random.default_rng(6).standard_normal((draws, AGENTS))
    expected = np.clip(2 + 4 * around, -2, 6)
    np.testing.assert_allclose(actions[..., 1].mean(0), expected.mean(0), atol=0.15)
    np.testing.assert_allclose(actions[..., 1].std(0), expected.std(0), atol=0.15)


@pytest.mark.parametrize("kind", ["values", "deterministic"])
def test_a_deterministic_policy_has_nothing_to_sample_from(kind: str, tmp_path: Path) -> None:
    folder, run = kept(tmp_path, kind)
    seen = drawn(run.spec.action_space, COPIES)
    with pytest.raises(HeadwayError, match="is deterministic"):
        load_policy(folder).act(seen.observations, seen.action_masks, deterministic=False)


def test_agents_by_name_act_as_in_arrays(tmp_path: Path) -> None:
    """An absent agent keeps its hidden state; one whose state is removed starts anew."""
    folder, run = kept(tmp_path, "recurrent")
    policy, seen = load_policy(folder), drawn(run.spec.action_space, COPIES)
    assert seen.action_masks is not None
    rows, masks = seen.observations, seen.action_masks
    first, state = policy.act(rows[0], masks[0])
    second, after = policy.act(rows[1], masks[1], state=state)
    named = dict(zip(policy.agents, rows[0], strict=True)), dict(zip(policy.agents, masks[0], strict=True))
    chosen, named_state = policy.act(*named)
    assert chosen == dict(zip(policy.agents, first, strict=True))
    some = {"a3": rows[1][3], "a0": rows[1][0]}
    chosen, named_state = policy.act(some, {"a0": masks[1][0], "a3": masks[1][3]}, state=named_state)
    assert chosen == {"a3": second[3], "a0": second[0]}
    np.testing.assert_allclose(named_state["a0"], after[0], atol=1e-6)
    np.testing.assert_allclose(named_state["a1"], state[1], atol=1e-6)
    del named_state["a1"]
    _, named_state = policy.act({"a1": rows[0][1]}, {"a1": masks[0][1]}, state=named_state)
    np.testing.assert_allclose(named_state["a1"], state[1], atol=1e-6)


ROWS, MASKS = np.zeros((AGENTS, SIZE)), np.ones((AGENTS, 3), bool)
WRONG: dict[str, tuple[Callable[[Policy], object], str]] = {
    "shape": (lambda p: p.act(ROWS[:, :2], MASKS), "observations must be of shape (..., 5, 3), not (5, 2)"),
    "no mask": (lambda p: p.act(ROWS), "needs the action masks"),
    "mask's shape": (lambda p: p.act(ROWS, MASKS[:, :2]), "mask must be of shape (5, 3), not (5, 2)"),
    "nothing allowed": (lambda p: p.act(ROWS, ~MASKS), "mask allows an agent no action"),
    "state's shape": (lambda p: p.act(ROWS, MASKS, state=np.zeros((5, 3))), "state must be of shape (5, 4)"),
    "unknown agent": (lambda p: p.act({"b": ROWS[0]}, {"b": MASKS[0]}), "the policy has no agent 'b'"),
    "agent without mask": (lambda p: p.act({"a0": ROWS[0]}, {}), "mask lacks agent a0"),
    "agent's shape": (
        lambda p: p.act({"a0": ROWS[0, :2]}, {"a0": MASKS[0]}),
        "observations of a0 must be of",
    ),
    "no number": (lambda p: p.act([["x"] * SIZE] * AGENTS, MASKS), "observations cannot be read as an array"),
    "result of reset": (lambda p: p.act(({"a0": ROWS[0]}, {}), MASKS), "pass the first of (observations"),
    "ragged": (lambda p: p.act([[0.0], []], MASKS), "observations cannot be read as an array"),
    "not finite": (
        lambda p: p.act(np.where(np.arange(AGENTS)[:, None] == 3, np.nan, ROWS), MASKS),
        "observations of a3 are not finite",
    ),
    "mixed": (lambda p: p.act({"a0": ROWS[0]}, MASKS), "mask must be a mapping"),
}


@pytest.fixture(scope="module")
def recurrent(tmp_path_factory: pytest.TempPathFactory) -> Kept:
    return kept(tmp_path_factory.mktemp("recurrent"), "recurrent")


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_argument_is_one_line(case: str, recurrent: Kept) -> None:
    act, line = WRONG[case]
    with pytest.raises(HeadwayError, match=re.escape(line)):
        act(load_policy(recurrent[0]))


def test_a_seed_is_no_generator(recurrent: Kept) -> None:
    with pytest.raises(HeadwayError, match=r"must be a numpy\.random\.Generator"):
        load_policy(recurrent[0]).act(ROWS, MASKS, generator=3)  # type: ignore[arg-type] # the bad input


def test_a_mask_or_state_that_the_policy_does_not_have_is_refused(tmp_path: Path) -> None:
    policy = load_policy(kept(tmp_path, "box")[0])
    with pytest.raises(HeadwayError, match="no action masks"):
        policy.act(ROWS, MASKS)
    with pytest.raises(HeadwayError, match="no hidden state"):
        policy.act(ROWS, state=np.zeros((AGENTS, 4)))


def test_a_file_needs_numpy_only_and_says_where_it_is_from(recurrent: Kept, tmp_path: Path) -> None:
    _, run = recurrent
    (tmp_path / "policy.npz").write_bytes(FORMATS["npz"].contents(run.description, run.arrays))
    code = (
        "import sys, numpy as np; from headway.api import load_policy; p = load_policy('policy.npz'); "
        f"p.act(np.zeros(({AGENTS}, {SIZE})), np.ones(({AGENTS}, 3)), deterministic=False); "
        "heavy = ('torch', 'numba', 'yaml', 'psutil', 'headway_algos', 'headway_envs', 'pandas'); "
        "print([name for name in heavy if name in sys.modules]); "
        "print(*[p.origin[k] for k in ('algorithm', 'iteration', 'seed', 'version.headway', 'git.revision')])"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert shown.stdout.splitlines() == ["[]", "ippo 5 7 0.1.0 abc"]


def test_a_copied_folder_needs_no_store(recurrent: Kept, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(recurrent[0], copy)
    assert load_policy(copy).origin == load_policy(str(recurrent[0])).origin


FEATURES = tuple(ObservationFeature(f"x{i}", f"number {i}", "m", 2.0 + i) for i in range(SIZE))


@pytest.mark.parametrize("form", ["npz", "onnx", "folder"])
def test_the_description_of_observations_travels_with_a_policy(form: str, tmp_path: Path) -> None:
    if form == "onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")
    source = keep_made(tmp_path, "ippo", replace(spec_with(BOX), observation_features=FEATURES))[0]
    if form != "folder":
        run = TrainedRun.read(source)
        source = tmp_path / f"policy{FORMATS[form].suffix}"
        source.write_bytes(FORMATS[form].contents(run.description, run.arrays))
    assert load_policy(source).observation_features == FEATURES


def test_the_described_normalisation_is_the_network_s(tmp_path: Path) -> None:
    """Numbers beyond the bounds that it describes change nothing; numbers within them do."""
    policy = load_policy(kept(tmp_path, "box")[0])
    told = policy.description.normalisation
    mean, scale = np.array(told["mean"]), np.array(told["scale"])
    assert mean.shape == scale.shape == (AGENTS, SIZE)  # a network per agent
    edge, beyond, within = (
        policy.evaluate((mean + part * told["clip"] / scale)[None].astype(np.float32), None, None).outputs[0]
        for part in (1.01, 3.0, 0.8)
    )
    np.testing.assert_allclose(edge, beyond, atol=1e-6)
    assert (np.abs(edge - within).max(axis=-1) > 1e-4).all()
    assert load_policy(kept(tmp_path / "other", "not normalised")[0]).description.normalisation == {}


@pytest.mark.parametrize("space", [Discrete(3), MultiDiscrete((2, 4)), BOX])
def test_a_stored_specification_is_the_same_when_read(space: ActionSpace) -> None:
    text = json.dumps(spec_json(spec_with(space)), allow_nan=False)
    assert spec_of(json.loads(text)) == spec_with(space)


def _foreign_npz() -> bytes:
    stream = io.BytesIO()
    np.savez(stream, weights=np.zeros(3))
    return stream.getvalue()


@pytest.mark.parametrize("suffix", [".npz", ".onnx", ".pt"])
@pytest.mark.parametrize("damage", ["truncated", "text", "empty", "foreign", "a byte"])
def test_a_bad_or_foreign_file_is_one_line(damage: str, suffix: str, recurrent: Kept, tmp_path: Path) -> None:
    if suffix == ".onnx":
        pytest.importorskip("onnxruntime")
    form = next(name for name, form in FORMATS.items() if form.suffix == suffix)
    whole = FORMATS[form].contents(recurrent[1].description, recurrent[1].arrays)
    if damage == "a byte" and suffix != ".npz":
        pytest.skip("only npz has checksums of its contents")
    middle = len(whole) // 2
    contents = {
        "truncated": whole[: len(whole) // 2], "text": b"no policy", "empty": b"", "foreign": _foreign_npz(),
        "a byte": whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :],
    }  # fmt: skip
    path = tmp_path / f"policy{suffix}"
    path.write_bytes(contents[damage])
    with pytest.raises(HeadwayError, match="is damaged or not a policy") as caught:
        read_policy(path)
    assert "\n" not in str(caught.value)


def test_an_array_of_another_shape_is_damage(recurrent: Kept, tmp_path: Path) -> None:
    _, run = recurrent
    arrays = {**run.arrays, "bias_1": run.arrays["bias_1"][:, :2]}
    (tmp_path / "policy.npz").write_bytes(FORMATS["npz"].contents(run.description, arrays))
    with pytest.raises(HeadwayError, match="is damaged"):
        load_policy(tmp_path / "policy.npz")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("hidden_layers", 10_000_000), ("hidden_layers", -1), ("activation", "gelu"), ("output", "softmax"),
        ("output", "mean"), ("policy_of_agent", [0, 0, 0, 0, -1]), ("policy_of_agent", [0]),
        ("index_of_agent", [0, 1]), ("hidden_size", -4),
    ],
)  # fmt: skip
def test_a_misfitting_description_is_damage(key: str, value: object, recurrent: Kept, tmp_path: Path) -> None:
    """A file of a stranger's: none of its values may lead to other actions, or to work without end."""
    content = json.loads(recurrent[1].description.to_json())
    content["network"][key] = value
    named: dict[str, Any] = {"headway.json": np.array(json.dumps(content)), **recurrent[1].arrays}
    np.savez(tmp_path / "policy.npz", **named)
    with pytest.raises(HeadwayError, match="is damaged or not a policy"):
        load_policy(tmp_path / "policy.npz")


def test_torchscript_is_not_run(recurrent: Kept, tmp_path: Path) -> None:
    (tmp_path / "policy.pt").write_bytes(b"a program")
    with pytest.raises(HeadwayError, match=r"a TorchScript file is a program.*with torch\.jit\.load"):
        load_policy(tmp_path / "policy.pt")


def test_the_file_of_an_environment_is_not_run(recurrent: Kept, tmp_path: Path) -> None:
    """A stranger's run: its configuration names a file that it brings along."""
    copy, file = tmp_path / "copy", tmp_path / "env.py"
    shutil.copytree(recurrent[0], copy)
    file.write_text("raise SystemExit('the code of a stranger ran')")
    config = yaml.safe_load((copy / "config.yaml").read_text())
    (copy / "config.yaml").write_text(yaml.safe_dump({**config, "env": {"id": str(file)}}))
    assert load_policy(copy).agents == recurrent[1].spec.agents


def test_what_is_no_policy_is_one_line(recurrent: Kept, tmp_path: Path) -> None:
    with pytest.raises(HeadwayError, match="is not the folder of a run"):
        load_policy(tmp_path)
    with pytest.raises(HeadwayError, match="must be a run's folder or a file ending in"):
        load_policy(tmp_path / "policy.zip")
    with pytest.raises(HeadwayError, match="there is no file"):
        load_policy(tmp_path / "policy.npz")
    copy = tmp_path / "copy"
    shutil.copytree(recurrent[0], copy)
    plan = json.loads((copy / "plan.json").read_text())
    for wrong in ({**plan, "spec": {}}, {**plan, "stack": [1]}, {**plan, "stack": None}):
        (copy / "plan.json").write_text(json.dumps(wrong))
        with pytest.raises(HeadwayError, match=r"plan\.json is damaged"):
            load_policy(copy)
    (copy / "plan.json").write_text(json.dumps(plan))
    shutil.rmtree(copy / "checkpoints")
    with pytest.raises(HeadwayError, match="there is no checkpoint"):
        load_policy(copy)


def test_a_policy_without_a_description_is_one_line(recurrent: Kept, monkeypatch: pytest.MonkeyPatch) -> None:
    entry, config = trained_run.chosen_algo({"name": "ippo"})
    other = replace(entry, acting_policy=lambda config, spec: object())
    monkeypatch.setattr(trained_run, "chosen_algo", lambda mapping: (other, config))
    with pytest.raises(HeadwayError, match="policies of ippo cannot be exported: its acting policy does not"):
        load_policy(recurrent[0])


def test_a_policy_that_splits_later_acts_with_one_network_per_agent(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"policies": "independent", "shared_until": 0.5}
    folder = keep_made(tmp_path, "ippo", spec_with(Discrete(3)), **settings)[0]
    run, seen = TrainedRun.read(folder), drawn(Discrete(3), COPIES)
    assert run.description.network.policy_of_agent == (0, 1, 2, 3, 4)
    require_parity(load_policy(folder), run.acting, run.parameters, seen, None)
