"""`headway render`: episodes by a rule and by a trained policy, and what it refuses."""

import json
import sys
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_lines import output, refused
from PIL import Image
from small_runs import SMALL

from headway_envs.merge.renderer import MergeRenderer
from headway_launch.commands import render
from headway_launch.commands.main import run
from headway_launch.console import video
from headway_launch.console.video import caption_strip

IDLE = ("merge", "--rule", "idle", "env.args.steps=4")


def frames(path: Path) -> list[tuple[int, int]]:
    with Image.open(path) as picture:
        sizes = []
        for index in range(getattr(picture, "n_frames", 1)):
            picture.seek(index)
            sizes.append(picture.size)
        return sizes


def test_a_rule_is_drawn_to_the_end_of_the_episode(tmp_path: Path) -> None:
    """The picture of a moment is one of the frames, and the episode is as long as it was told to be."""
    moving, still = tmp_path / "idle.gif", tmp_path / "idle.png"
    words = ["render", "merge", "--rule", "random", "env.args.steps=6"]
    assert run([*words, "--output", str(moving)]) == 0
    assert run([*words, "--output", str(still), "--step", "3"]) == 0
    assert len(frames(moving)) == 7
    assert frames(still) == frames(moving)[:1]
    with Image.open(moving) as picture, Image.open(still) as moment:
        picture.seek(3)
        apart = np.abs(np.asarray(picture.convert("RGB"), int) - np.asarray(moment, int))
    assert np.quantile(apart, 0.9999) < 40  # the palette has the few yellow pixels of the obstacle, too


@pytest.mark.parametrize(("steps", "fps"), [(6, 5.0), (301, 25.0)])
def test_a_long_episode_is_shown_faster(
    steps: int, fps: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame, rates = np.zeros((2, 2, 3), np.uint8), list[float]()
    monkeypatch.setattr(render, "_frames", lambda *_: (frame for _ in range(steps + 1)))
    monkeypatch.setattr(video, "write_film", lambda frames, output, rate, caption: rates.append(rate))
    assert run(["render", *IDLE, "--output", str(tmp_path / "idle.gif")]) == 0
    assert rates == [fps]


def test_an_mp4_has_the_frames_and_the_rate_of_the_episode(tmp_path: Path) -> None:
    reader = pytest.importorskip("imageio_ffmpeg")
    output, still = tmp_path / "idle.mp4", tmp_path / "idle.png"
    assert run(["render", *IDLE, "--fps", "4", "--output", str(output)]) == 0
    assert run(["render", *IDLE, "--output", str(still)]) == 0
    assert reader.count_frames_and_secs(str(output)) == (5, pytest.approx(1.25))
    played = reader.read_frames(str(output))
    size = next(played)["size"]
    *_, last = (np.frombuffer(frame, np.uint8).reshape(size[1], size[0], 3) for frame in played)
    with Image.open(still) as picture:
        moment = np.asarray(picture, int)[: size[1], : size[0]]
    assert np.abs(last - moment).mean() < 4  # the codec loses little


def test_an_mp4_without_its_extra_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr(MergeRenderer, "render", None)
    line = refused("render", *IDLE, "--output", str(tmp_path / "idle.mp4"))
    assert 'an .mp4 needs the package imageio-ffmpeg; install it with pip install "headway[video]"' in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".png", ".gif"])
def test_a_picture_names_its_controller(tmp_path: Path, suffix: str) -> None:
    """The name is in the file's text and, for viewers, beneath the episode."""
    strips = {}
    for seed in ("5", "6"):
        output = tmp_path / f"{seed}{suffix}"
        words = ["render", "merge", "--rule", "idle", "env.args.steps=2", "--seed", seed, "--episode", "1"]
        assert run([*words, "--output", str(output)]) == 0
        with Image.open(output) as picture:
            said = picture.info["Title"] if suffix == ".png" else picture.info["comment"].decode()
            strips[seed] = np.asarray(picture.convert("L"))[-25:] < 128
        assert said == f"rule idle on merge, env.args.steps=2: evaluation episode 1 of seed {seed}"
    assert strips["5"].sum() > 500  # there is something to read
    assert 0 < (strips["5"] != strips["6"]).any(axis=0).sum() < 15  # columns: one digit differs


@pytest.mark.parametrize("word", ["WWW", "ill "])
def test_a_long_caption_takes_more_lines_and_loses_nothing(word: str) -> None:
    one, many = (caption_strip(word * count, 200) for count in (2, 160))
    assert one.shape[1] == many.shape[1] == 200
    assert many.shape[0] > 5 * one.shape[0]
    assert (many[:, -3:] == 255).all()


@pytest.mark.parametrize("suffix", [".png", ".gif"])
def test_the_frames_of_an_episode_are_not_all_held_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    rendered: list[weakref.ref[Any]] = []
    most = 0

    def render(self: object, env: object, at_end: bool) -> np.ndarray:
        nonlocal most
        frame = np.full((40, 40, 3), len(rendered), np.uint8)
        rendered.append(weakref.ref(frame))
        most = max(most, sum(one() is not None for one in rendered))
        return frame

    monkeypatch.setattr(MergeRenderer, "render", render)
    output = tmp_path / f"idle{suffix}"
    words = ["render", "merge", "--rule", "idle", "env.args.density=1", "env.args.steps=30"]
    assert run([*words, "--output", str(output)]) == 0
    assert len(rendered) == 31
    assert most <= 3


def test_a_moments_picture_needs_only_earlier_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rendered, render = [], MergeRenderer.render
    monkeypatch.setattr(
        MergeRenderer, "render", lambda *words, **named: rendered.append(1) or render(*words, **named)
    )
    words = ["render", "merge", "--rule", "idle", "env.args.steps=20", "--step", "2"]
    assert run([*words, "--output", str(tmp_path / "moment.png")]) == 0
    assert len(rendered) == 3


@pytest.mark.slow
def test_a_trained_policy_is_drawn_behind_its_wrappers(tmp_path: Path) -> None:
    store = tmp_path / "runs"
    words = [
        "env.args.steps=5", "env.wrappers=[{name: frame_stack_v1, stack_size: 2}]", "algo.model.hidden=[8]",
        "rollout.steps=32", "rollout.copies=2", "rollout.block=2", "evaluation.rules=[]", "preset=none",
        "seed=0", "backend=serial", f"store.root={store}",
    ]  # fmt: skip
    assert run(["run", "experiment=merge_mappo", *SMALL, *words]) == 0
    moving = tmp_path / "policy.gif"
    assert run(["render", "s0", "--store", str(store), "--output", str(moving)]) == 0
    assert len(frames(moving)) == 6
    [record] = store.glob("*/*/run.json")
    assert json.loads(record.read_text())["preset"] == "none"
    with Image.open(moving) as picture:
        said = picture.info["comment"].decode()
    told = f"run {record.parent.name} after 1 iteration, greedy: evaluation episode 0 of seed"
    assert said.startswith(told)
    keep = ["render", "s0", "--store", str(store), "--output", "end.png", "--keep"]
    refused(*keep, "--step", "9")
    assert list(store.glob("**/pictures")) == []  # made for a picture only
    assert run(keep) == 0
    [kept] = store.glob("**/pictures/end.png")
    assert frames(kept) == frames(moving)[:1]
    kept.unlink()
    kept.parent.rmdir()
    kept.parent.write_text("in the way")
    assert refused(*keep).startswith(f"headway: --output: {kept} cannot be written")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["merge", "--output", "a.png"],
            "merge is an environment; add --rule RULE (`headway list rules merge`), or name",
        ),
        (["s0"], "there is no store in 'runs'"),
        (["buss"], "unknown run or environment 'buss'; did you mean bus, with --rule RULE?"),
        (["merge", "--rule", "idel"], "--rule: unknown rule 'idel'; did you mean idle?"),
        (["trivial", "--rule", "random"], "trivial cannot be rendered; environments that can: bus, inter"),
        (["merge", "--rule", "idle", "--output", "a.avi"], "--output: a.avi must end in .gif, .mp4 or .png"),
        (["merge", "--rule", "idle", "--step", "3"], "--step needs a single picture"),
        (["merge", "--rule", "idle", "--episode", "-1"], "--episode, --seed and --step must be at least 0"),
        (["merge", "--rule", "idle", "--keep"], "--keep works for runs only; omit --keep or --rule"),
        (["s0", "--output", "a/b.png", "--keep"], "with --keep give a name without a folder, b.png, not"),
        (["merge", "--rule", "idle", "--fps", "0"], "--fps must lie between 0.1 and 50, not 0"),
        (["s0", "env.args.density=3"], "env.args.density=3: a run is rendered with its own configuration"),
        ([*IDLE, "--output", "a.png", "--step", "9"], "--step: the episode ends after 4 steps, before 9"),
    ],
)
def test_what_cannot_be_drawn_is_one_line(words: list[str], line: str, empty_folder: Path) -> None:
    assert line in refused("render", *words)
    assert list(empty_folder.iterdir()) == []


def test_a_study_named_almost_like_an_environment_is_a_study(empty_folder: Path) -> None:
    run = empty_folder / "runs" / "buss" / "one-s0"
    run.mkdir(parents=True)
    (run / "run.json").write_text("{}")
    assert "'buss' is a study in runs: name one of its runs, one-s0" in refused("render", "buss")


def test_an_environment_whose_name_runs_have_is_told_with_those_runs(empty_folder: Path) -> None:
    for seed in range(7):
        run = empty_folder / "runs" / "bus" / f"bus-ippo-s{seed}-2026010{seed}-120000-ab"
        run.mkdir(parents=True)
        (run / "run.json").write_text("{}")
    *most, last = (f"bus-ippo-s{seed}" for seed in (2, 3, 4, 5, 6))
    named = f"such as {', '.join(most)} or {last} (7 in all)"
    line = f"bus is an environment; add --rule RULE (`headway list rules bus`), or name a run, {named}\n"
    assert refused("render", "bus").endswith(line)
    assert f"'ippo' is part of the names of 7 runs: name one, {named}" in refused("render", "ippo")
    assert f"'bus' is a study in runs: name one of its runs, {named}" in refused("export", "bus")
    again = empty_folder / "runs" / "bus" / "bus-ippo-s3-20260107-120000-cd"
    again.mkdir()
    (again / "run.json").write_text("{}")
    both = "bus-ippo-s3-20260107-120000-cd or bus-ippo-s3-20260103-120000-ab"
    assert f"2 runs: name one, {both}; `headway runs` shows" in refused("export", "ippo-s3")


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("output", ["no/where.gif", "taken.gif", "file/inside.png"])
def test_where_nothing_can_be_written_nothing_is_played(output: str, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("taken.gif").mkdir()
    Path("file").write_text("")
    rendered: list[int] = []
    monkeypatch.setattr(MergeRenderer, "render", lambda *words, **named: rendered.append(1))
    told = refused("render", "merge", "--rule", "idle", "--output", output)
    assert told.startswith(f"headway: --output: {output} cannot be written (")
    assert "Errno" not in told
    assert ("there is no folder no; create it first" in told) == output.startswith("no/")
    assert rendered == []


def test_a_terminal_is_told_how_far_an_episode_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    told = output("render", *IDLE, "--output", str(tmp_path / "a.gif")).err
    assert "steps played: " in told
    assert "frames written: 5 of 5" in told
    moment = output("render", *IDLE, "--output", str(tmp_path / "a.png"), "--step", "3").err
    assert "steps played: 3 of 3" in moment


def test_a_bus_day_is_drawn_as_map_and_diagram(tmp_path: Path) -> None:
    output = tmp_path / "day.png"
    words = ["render", "bus", "--rule", "always_move", "env.args.end_hour=6", "--output", str(output)]
    assert run(words) == 0
    assert frames(output)[0][0] == 1180


_PAINTED = """
import numpy as np
from scripted import Scripted

class parallel_env(Scripted):
    def __init__(self, mode: str = "rgb_array"):
        super().__init__(length=5)
        self.mode = mode

    def render(self):
        return np.full((40, 60, 3), 10 * self.steps, np.uint8) if self.render_mode == self.mode else None
"""


def test_a_module_environment_is_rendered_by_its_own_pictures(empty_folder: Path) -> None:
    """The last frame repeats the one before, since the environment has begun the next episode."""
    Path("painted.py").write_text(_PAINTED)
    words = ["render", "./painted.py", "--rule", "random", "env.shared_reward=false"]
    assert run(words) == 0
    with Image.open("painted.gif") as film:
        assert film.n_frames >= 5
    for step, shade in ((0, 0), (3, 30), (5, 40)):
        assert run([*words, "--step", str(step), "--output", "moment.png"]) == 0
        with Image.open("moment.png") as picture:
            assert picture.getpixel((5, 5)) == (shade,) * 3
    assert "must return an RGB picture" in refused(*words, "env.args.mode=human")
    Path("bare.py").write_text(_PAINTED.replace("def render", "def paint"))
    line = refused("render", "./bare.py", "--rule", "random", "env.shared_reward=false")
    assert line.endswith("bare.py cannot be rendered: write a method render() that returns an RGB picture\n")
