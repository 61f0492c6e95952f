"""`headway render`: render an episode as an animated GIF or MP4 video, or one of its steps as a PNG."""

import argparse
import shlex
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.config.schema import nearest
from headway.contracts.errors import HeadwayError
from headway.wording import counted
from headway_launch.commands.arguments import add_config_dir_argument, add_store_argument, existing_store
from headway_launch.console.output_files import require_writable
from headway_launch.console.progress_display import CountedProgress

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from headway.contracts import BatchedEnv, Observations, StepResult
    from headway_launch.console.video import Frame
    from headway_launch.experiments.experiment import PreparedEnv
    from headway_launch.runner.stored_run import StoredRun

    Act = Callable[[Any, Observations], NDArray[Any]]
    ResetEnded = Callable[[StepResult], None]

EXAMPLES = """\
examples:
  headway render s0-20260101-1200                  newest policy of a run, greedy actions
  headway render merge --rule idm_mobil            a rule on an environment
  headway render merge --rule always_left env.args.density=3 --episode 4 --output crash.gif
  headway render merge --rule idle --step 60 --output moment.png
  headway render bus --rule even_headway --output day.png      map and time-space diagram of the day
  headway render bus --rule even_headway                       animated over the hours of the day
  headway render bus --rule even_headway --output day.mp4      smaller (extra: video)
  headway render ./shuttle.py --rule random                    any environment with the render mode rgb_array
  headway render s0-20260101-1200 --keep                       written into the run's folder

A .gif or .mp4 shows the whole episode; a .png shows one step (the last, or that of --step). The caption names
the rule or run, the seed and the number of the episode. PettingZoo and Gymnasium environments are rendered
by their own `render` with the mode rgb_array, without the last step.
"""
_SUFFIXES = (".gif", ".mp4", ".png")
_LONG_STEPS = 300
"""Steps of an episode above which a video is faster by default: a minute of video, at 5 steps per second."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the run or environment, the episode and the output."""
    parser.add_argument(
        "name", metavar="RUN|ENV", help="a run, or with --rule an environment (`headway list envs`)"
    )
    parser.add_argument(
        "overrides",
        metavar="KEY=VALUE",
        nargs="*",
        default=[],
        help="overrides of the environment (only with --rule), such as env.args.density=3",
    )
    parser.add_argument("--rule", help="rule to render (default: the run's policy)")
    parser.add_argument(
        "--episode", type=int, default=0, help="number of the evaluation episode (default: 0)"
    )
    parser.add_argument("--seed", type=int, help="root of the episode seeds (default: evaluation.seed)")
    parser.add_argument("--step", type=int, help="step that a .png shows (default: the last)")
    parser.add_argument("-o", "--output", help="file to write (default: NAME.gif)")
    parser.add_argument(
        "--fps",
        type=float,
        help=f"steps per second of a video (default: 5; 25 in episodes of more than {_LONG_STEPS} steps)",
    )
    parser.add_argument(
        "--keep",
        action="store_true",
        help="write into pictures/ of the run's folder",
    )
    add_config_dir_argument(parser)
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Render the episode and print the path of the file."""
    output = Path(arguments.output or f"{Path(arguments.name).name.removesuffix('.py')}.gif")
    _check(arguments, output)
    if arguments.keep:
        output = _in_run(arguments, output)
    folder = output.parent.parent if arguments.keep and not output.parent.exists() else output.parent
    require_writable("--output", output, folder)
    from headway.registry import env_entries
    from headway_launch.console.video import PackedFrame, mp4_writer, write_film, write_mp4, write_picture
    from headway_launch.runner.warm_up import compile_kernels

    if output.suffix == ".mp4":
        mp4_writer()  # refused before anything is played
    player = _player(arguments)
    found = player.environment
    if found.entry.renderer is None:
        renderable = sorted(name for name, entry in env_entries().items() if entry.renderer is not None)
        raise HeadwayError(
            f"{found.spec.name} cannot be rendered; environments that can: {', '.join(renderable)}"
        )
    compile_kernels(found.entry)
    root = player.root if arguments.seed is None else arguments.seed
    caption = f"{player.name}: evaluation episode {arguments.episode} of seed {root}"
    with closing(_frames(player, root, arguments.episode, caption, arguments.step)) as frames:
        if output.suffix == ".png":
            write_picture(_picture_at(frames, arguments.step), output, caption)
        else:
            packed = [PackedFrame.of(frame) for frame in frames]
            write = write_mp4 if output.suffix == ".mp4" else write_film
            fps = 25.0 if len(packed) > _LONG_STEPS + 1 else 5.0
            write(packed, output, fps if arguments.fps is None else arguments.fps, caption)
    print(output)
    return 0


def _check(arguments: argparse.Namespace, output: Path) -> None:
    if output.suffix not in _SUFFIXES:
        raise HeadwayError(f"--output: {output} must end in {', '.join(_SUFFIXES[:-1])} or {_SUFFIXES[-1]}")
    if arguments.step is not None and output.suffix != ".png":
        png = shlex.quote(str(output.with_suffix(".png")))
        raise HeadwayError(f"--step needs a single picture: give --output {png}")
    if arguments.episode < 0 or (arguments.seed or 0) < 0 or (arguments.step or 0) < 0:
        raise HeadwayError("--episode, --seed and --step must be at least 0")
    if arguments.fps is not None and not 0.1 <= arguments.fps <= 50.0:
        raise HeadwayError(f"--fps must lie between 0.1 and 50, not {arguments.fps:g}")
    if arguments.keep and arguments.archive is not None:
        raise HeadwayError("--keep writes into the run's folder, and an archive is only read; omit --keep")
    if arguments.keep and arguments.rule is not None:
        raise HeadwayError("--keep works for runs only; omit --keep or --rule")
    if arguments.keep and output.name != str(output):
        raise HeadwayError(f"--output: with --keep give a name without a folder, {output.name}, not {output}")
    if arguments.overrides and arguments.rule is None:
        raise HeadwayError(
            f"{arguments.overrides[0]}: a run is rendered with its own configuration; omit this"
        )


def _in_run(arguments: argparse.Namespace, output: Path) -> Path:
    """Return the path of a picture in its run's folder."""
    from headway_launch.runner.stored_run import StoredRun

    run = StoredRun.find(existing_store(arguments.store), arguments.name)
    return run.directory / "pictures" / output.name


@dataclass(frozen=True)
class _Player:
    """A policy or rule with its environment."""

    name: str
    environment: "PreparedEnv"
    root: int
    """Root of the evaluation seeds."""
    make: "Callable[[], BatchedEnv]"
    """Makes a single copy of the environment."""
    act: "Act"
    reset_ended: "ResetEnded"
    """Processes the result of each step, to update hidden states."""


def _player(arguments: argparse.Namespace) -> _Player:
    if arguments.rule is None:
        from headway.rollout.policy_player import PolicyPlayer
        from headway_launch.runner.checkpointed_policy import stored_policy

        run = _run(arguments)
        found = run.experiment.prepare()
        policy = stored_policy(run, found)
        acting = PolicyPlayer(policy.plan, 1, 1)
        root = run.experiment.config.evaluation.seed
        return _Player(
            f"run {run.record.run_id} after {counted(policy.iteration, 'iteration')}, greedy",
            found,
            root,
            lambda: policy.plan.make(1),
            lambda env, observed: acting.act(policy.parameters, observed, None)[0],
            acting.reset_ended,
        )
    from headway.registry import rule_entry
    from headway_launch.experiments.compose import compose
    from headway_launch.experiments.override_words import require_each_key_once

    words = [f"env={arguments.name}", *arguments.overrides]
    require_each_key_once(words)
    experiment = compose(words)
    found = experiment.prepare_environment()
    try:
        rule = rule_entry(experiment.env, arguments.rule).make(found.prepared)
    except HeadwayError as error:
        raise HeadwayError(f"--rule: {error}") from error
    settings = f", {' '.join(arguments.overrides)}" if arguments.overrides else ""
    return _Player(
        f"rule {arguments.rule} on {arguments.name}{settings}",
        found,
        experiment.config.evaluation.seed,
        lambda: found.entry.make(found.prepared, 1),
        rule.act,
        lambda outcome: None,
    )


def _run(arguments: argparse.Namespace) -> "StoredRun":
    """Return the named run. Raises HeadwayError, with a hint, if the name is not a run's."""
    from headway.store.run_folder import first_runs, run_folders
    from headway_launch.experiments.options import options
    from headway_launch.runner.stored_run import StoredRun

    try:
        return StoredRun.find(existing_store(arguments.store), arguments.name)
    except HeadwayError as error:
        known, folders = options()["env"], list(run_folders(Path(arguments.store)))
        runs = [
            folder.name
            for folder in folders
            if arguments.name in folder.name or arguments.name == folder.parent.name
        ]
        if arguments.name in known:
            named = f", {first_runs(runs, [folder.name for folder in folders])}" if runs else ""
            raise HeadwayError(
                f"{arguments.name} is an environment; add --rule RULE "
                f"(`headway list rules {arguments.name}`), or name a run{named}"
            ) from error
        if not runs and (near := nearest(arguments.name, known)):
            raise HeadwayError(
                f"unknown run or environment {arguments.name!r}; did you mean {near}, with --rule RULE? "
                "`headway runs` shows the runs"
            ) from error
        raise


def _frames(
    player: _Player, root: int, episode: int, caption: str, steps: int | None = None
) -> "Generator[Frame]":
    """Yield pictures of one evaluation episode above its caption, until the episode ends.

    `steps`: number that the caller needs, for the time left; None: all, of unknown number.
    """
    import numpy as np

    from headway.rollout.episodes import evaluation_seeds
    from headway.wrappers.wrapped_env import behind_wrappers
    from headway_launch.console.video import caption_strip

    found = player.environment
    assert found.entry.renderer is not None
    renderer = found.entry.renderer(found.prepared)
    with CountedProgress("steps played", steps) as progress, closing(player.make()) as env:
        observed, ended = env.reset(evaluation_seeds(root, episode, 1)), False
        first = renderer.render(behind_wrappers(env), at_end=False)
        strip = caption_strip(caption, first.shape[1])
        yield np.concatenate((first, strip))
        del first
        while not ended:
            outcome, observed = env.step(player.act(env, observed))
            player.reset_ended(outcome)
            ended = bool(outcome.episode_ended[0])
            progress.add()
            yield np.concatenate((renderer.render(behind_wrappers(env), at_end=ended), strip))


def _picture_at(frames: "Iterator[Frame]", step: int | None) -> "Frame":
    """Return the picture after `step` steps, or the last one.

    Earlier pictures are rendered too, because a renderer may show recent events. Raises HeadwayError if the
    episode ends before.
    """
    last, played = next(frames), 0
    while played != step:
        following = next(frames, None)
        if following is None:
            break
        last, played = following, played + 1
    if step is not None and played < step:
        raise HeadwayError(f"--step: the episode ends after {played} steps, before {step}")
    return last
