"""`headway export`: write a trained policy to a file that can be used without the platform."""

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.config.schema import suggestion
from headway.contracts.errors import EnvironmentRaisedError, HeadwayError
from headway_launch.commands.arguments import add_best_argument, add_store_argument, existing_store
from headway_launch.console.output_files import require_writable
from headway_launch.console.progress_display import CountedProgress

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from headway.contracts import EnvSpec, Observations
    from headway.policies.trained_run import TrainedRun
    from headway_launch.experiments.experiment import PreparedEnv
    from headway_launch.runner.stored_run import StoredRun

EXAMPLES = """\
examples:
  headway export s0-20260101-1200                                any unique part of a run's name
  headway export RUN --format onnx --output policy.onnx
  headway export RUN --format torchscript --best

`headway.api.load_policy` reads .npz, which needs numpy only, and .onnx. Before it is written, the file is
compared with what rollout workers compute; a difference is an error. docs/howto/policies.md explains its
contents. For the logs of a study see `headway convert`.
"""
_COPIES, _STEPS, _RANDOM_ROWS = 4, 100, 256


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the run, the format and the output."""
    parser.add_argument("run", metavar="RUN", help="name of the run, as in `headway runs`")
    parser.add_argument("--format", default="npz", help="npz, onnx or torchscript (default: npz)")
    parser.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        help="file to write (default: RUN.npz, RUN.onnx or RUN.pt; with --best RUN-best.npz, ...)",
    )
    add_best_argument(parser)
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Check the exported policy against the rollout worker's, write it and print the path of the file."""
    from headway.policies.files import FORMATS
    from headway.policies.trained_run import TrainedRun
    from headway.store.atomic_files import write_durably
    from headway_launch.console.output import print_line
    from headway_launch.runner.stored_run import StoredRun

    if arguments.format not in FORMATS:
        raise HeadwayError(f"--format: unknown {arguments.format!r}; {suggestion(arguments.format, FORMATS)}")
    form = FORMATS[arguments.format]
    run = StoredRun.find(existing_store(arguments.store), arguments.run)
    which = "-best" if arguments.best else ""
    output = Path(arguments.output or f"{run.directory.name}{which}{form.suffix}")
    if output.suffix != form.suffix:
        raise HeadwayError(
            f"--output: {output} must end in {form.suffix}, the suffix of --format {arguments.format}"
        )
    require_writable("--output", output, output.parent)
    form.require_packages()
    trained = TrainedRun.read(run.directory, arguments.best)
    for line in trained.notices:
        print_line(f"headway: {line}")
    print_line("preparing the training environment, to compare the file with the rollout worker on it")
    environment, reason = _environment(run, trained.spec)
    description = trained.description
    if environment is not None and (source := getattr(environment.prepared, "source", None)):
        description = replace(description, origin={**description.origin, "data": source})
    print_line(f"making the file, {arguments.format}")
    content = form.contents(description, trained.arrays)
    try:
        rows = _compared(content, form.suffix, trained, environment)
    except EnvironmentRaisedError as error:
        environment, reason = None, str(error)
        rows = _compared(content, form.suffix, trained, None)
    write_durably(output, lambda stream: stream.write(content))
    origin = "of the training environment" if environment is not None else f"drawn at random ({reason})"
    kind = "best" if arguments.best else "newest"
    print_line(
        f"{kind} policy, of iteration {description.origin['iteration']}; equal to the rollout worker's on "
        f"{rows:,} observations {origin}"
    )
    print(output)
    return 0


def _compared(content: bytes, suffix: str, trained: "TrainedRun", environment: "PreparedEnv | None") -> int:
    """Compare the file's policy with the rollout worker's; return the number of observations of live agents.

    Raises HeadwayError if they differ.
    """
    from headway.policies.files import read_policy
    from headway.policies.parity import require_parity

    steps = 1 if environment is None else _STEPS
    with tempfile.TemporaryDirectory() as folder, CountedProgress("steps compared", steps) as progress:
        file = Path(folder, f"policy{suffix}")
        file.write_bytes(content)
        policy, rows = read_policy(file), 0
        for observed, state in _random(trained) if environment is None else _played(trained, environment):
            require_parity(policy, trained.acting, trained.parameters, observed, state)
            rows += int(observed.alive.sum())
            progress.add()
    return rows


def _environment(run: "StoredRun", spec: "EnvSpec") -> "tuple[PreparedEnv | None, str]":
    """Return the run's environment, or None and the reason why it cannot provide observations.

    `spec`: specification of the environment that the policy was trained on.
    """
    try:
        found = run.experiment.prepare()
    except HeadwayError as error:
        return None, str(error)
    if found.spec != spec:
        return None, f"{spec.name} has changed since the training"
    return found, ""


def _played(
    trained: "TrainedRun", environment: "PreparedEnv"
) -> "Iterator[tuple[Observations, NDArray[Any] | None]]":
    """Play the training environment with sampled actions; yield observations and hidden states."""
    import numpy as np

    from headway.contracts import child_seeds, generator
    from headway.rollout.plan import RolloutPlan
    from headway.rollout.policy_player import PolicyPlayer
    from headway_launch.runner.warm_up import compile_kernels

    entry, acting, seed = environment.entry, trained.acting, int(trained.description.origin["seed"])
    compile_kernels(entry)
    copies = min(_COPIES, trained.spec.max_copies_per_process or _COPIES)
    spec, training = trained.spec.for_policies, environment.training
    shared = environment.prepared
    plan = RolloutPlan(entry.make, (), shared, spec, acting, (seed,), copies, _STEPS, copies, training)
    player = PolicyPlayer(plan, copies, copies)
    draws = [generator(seed, "export action", copy) for copy in range(copies)]
    noise = np.stack([acting.noise(draw, _STEPS) for draw in draws], axis=1)
    with closing(plan.make_for_training(copies)) as env:
        observed = env.reset(child_seeds(seed, "export", 0, copies))
        for step in range(_STEPS):
            yield observed, player.hidden_states if trained.description.network.hidden_size else None
            actions = player.act(trained.parameters, observed, noise[step])[0]
            outcome, observed = env.step(actions)
            player.reset_ended(outcome)


def _random(trained: "TrainedRun") -> "Iterator[tuple[Observations, NDArray[Any] | None]]":
    """Yield standard normal observations and hidden states, and random action masks."""
    import numpy as np

    from headway.contracts import Observations, generator

    description, draw = trained.description, generator(0, "export observations")
    agents, shape = len(description.agents), (_RANDOM_ROWS, len(description.agents))
    observations = draw.standard_normal((*shape, description.observation_size)).astype(np.float32)
    masks = None
    if description.has_action_mask:
        # The first option of each choice is always allowed.
        masks = draw.random((*shape, sum(description.action_space.options))) < 0.5
        masks[..., np.cumsum((0, *description.action_space.options[:-1]))] = True
    size = description.network.hidden_size
    state = draw.standard_normal((*shape, size)).astype(description.precision) if size else None
    alive = np.ones((_RANDOM_ROWS, agents), np.bool_)
    states = np.zeros((_RANDOM_ROWS, trained.spec.state_size), np.float32)
    yield Observations(observations, states, alive, masks), state
