"""The `headway` command. Heavy modules are imported only by the commands that use them."""

import argparse
import os
import re
import shlex
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

from headway.config.schema import nearest, suggestion
from headway.contracts.errors import EnvironmentRaisedError, HeadwayError, one_line
from headway_launch.console.output import distinct_notices, exit_of_environment, print_line, silence
from headway_launch.console.threads import limit_threads

_ABOUT = "Multi-agent reinforcement-learning experiments in transport."
_EXAMPLES = """\
examples:
  headway list experiments
  headway run experiment=bus_mappo seed=0..4 algo.lr=3e-4
  headway runs
  headway browse

`headway COMMAND --help` shows details. An error is one line; --debug adds the traceback.
"""


@dataclass(frozen=True)
class Command:
    """A command of `headway`, or one of its subcommands."""

    summary: str
    module: str
    only_prints: bool = True
    """Whether a closed output pipe ends the command; False for commands that train."""
    parts: "Mapping[str, Command]" = field(default_factory=dict)
    """Subcommands by name; `module` is then a package with EXAMPLES."""


COMMANDS = {
    "run": Command("train all seeds of an experiment", "run", only_prints=False),
    "sweep": Command(
        "train every combination of values and seeds that is not in the store", "sweep", only_prints=False
    ),
    "search": Command(
        "search hyper-parameters, with one budget for all algorithms", "search", only_prints=False
    ),
    "resume": Command("continue runs that were stopped, killed or failed", "resume", only_prints=False),
    "runs": Command("list the runs in the store", "runs"),
    "diff": Command("compare the settings and results of two runs", "diff"),
    "evaluate": Command("evaluate a trained policy and the classical rules", "evaluate"),
    "export": Command("write a trained policy as npz, ONNX or TorchScript file", "export"),
    "compare": Command("compare a study's cells and the rules on the same episodes", "compare"),
    "plot": Command("plot a study's learning curves", "plot"),
    "convert": Command(
        "write a study's logs as CSV or for TensorBoard, Weights & Biases or marl-eval", "convert"
    ),
    "archive": Command("write the runs of a study to one file, to publish", "archive"),
    "verify": Command(
        "check an archive, retrain one of its runs and compare the curves", "verify", only_prints=False
    ),
    "render": Command("render an episode of a policy or a rule as GIF, MP4 or PNG", "render"),
    "report": Command("write a study's report: one page with tables and plots", "report"),
    "browse": Command("browse studies, reports and runs in a web browser", "browse"),
    "sync": Command("send run data that MLflow lacks", "sync"),
    "data": Command(
        "create, describe, plot and validate scenarios of the bus environment",
        "data",
        parts={
            "synthetic": Command("write a synthetic scenario", "data.synthetic"),
            "gtfs": Command("write a scenario from a GTFS feed", "data.gtfs"),
            "csv": Command("write a scenario from an operator's own CSV files", "data.csv_files"),
            "transitgym": Command("write a scenario from a line in TransitGym's tables", "data.transitgym"),
            "sunt": Command("write a scenario from SUNT's raw files", "data.sunt"),
            "describe": Command(
                "show lines, stops, fleet, headways and demand of a scenario", "data.describe"
            ),
            "plot": Command("plot a map of a scenario with loads and headways", "data.plot"),
            "realism": Command("compare simulated days with measured data", "data.realism"),
        },
    ),
    "list": Command(
        "list environments, algorithms, wrappers, rules, metrics, observations, experiments, presets, "
        "searches, spaces, keys or a schema",
        "listing",
    ),
}
"""Every command by name."""
_NOT_A_NUMBER = re.compile(r"argument (?P<option>\S+): invalid (?P<kind>int|float) value: '(?P<value>.*)'")
_ONE_THREAD = ("run", "sweep", "search", "resume", "evaluate", "export", "compare", "render", "verify")
"""Commands whose numerical libraries use one thread, because parallel processes fill the machine."""
_CUTOFF = 0.7
"""Least similarity of an unknown option to the one that is proposed."""


class _Parser(argparse.ArgumentParser):
    def __init__(self, words: Sequence[str], **options: Any) -> None:  # noqa: ANN401 - argparse's
        """`words`: the words to be parsed, for errors."""
        super().__init__(**options)
        self._words = words

    def error(self, message: str) -> NoReturn:
        if found := _NOT_A_NUMBER.fullmatch(message):
            kind = "a whole number" if found["kind"] == "int" else "a number"
            raise HeadwayError(f"{found['option']} {found['value']}: give {kind}")
        unknown = message.removeprefix("unrecognized arguments: ")
        if unknown != message:
            if fix := self._store_option(message):
                raise HeadwayError(f"{message}; {self.prog} takes {fix}")
            option = unknown.split()[0].split("=")[0]
            if fix := self._override(option):
                raise HeadwayError(f"{message}; write {fix}")
            names = {name.lstrip("-"): name for name in self._option_string_actions}
            if option.startswith("--") and (near := nearest(option.lstrip("-"), names, _CUTOFF)):
                raise HeadwayError(f"{message}; did you mean {names[near]}? See {self.prog} --help")
        raise HeadwayError(f"{message}; see {self.prog} --help")

    def _override(self, option: str) -> str:
        """Return the override that a mistaken option stands for, if this command trains and it names a key or
        a group of configurations; else an empty string."""
        key = option.removeprefix("--").replace("-", "_")
        if self.get_default("dry_run") is None or key == option:
            return ""
        from headway_launch.commands.completion import override_completions

        if f"{key}=" not in override_completions(self._words, key):
            return ""
        return f"{key}={self._typed_value(option)}"

    def _typed_value(self, option: str) -> str:
        """Return the value of `option` on the command line, quoted for a shell, or VALUE if it has none."""
        place = next(i for i, word in enumerate(self._words) if word.startswith(option))
        _, has_value, value = self._words[place].partition("=")
        following = [word for word in self._words[place + 1 : place + 2] if not word.startswith("-")]
        return shlex.quote(value if has_value else "".join(following) or "VALUE")

    def _store_option(self, message: str) -> str:
        """Return the store option that this command takes, if an error is about the other form; else an empty
        string."""
        if "store.root=" in message and self.get_default("store") is not None:
            return f"--store {self._typed_value('store.root')}"
        trains = self.get_default("dry_run") is not None
        return f"store.root={self._typed_value('--store')}" if "--store" in message and trains else ""


def main() -> None:
    """Entry point of the `headway` script: run the command line and exit with its code."""
    if "_ARGCOMPLETE" in os.environ:  # set by the function that completes words in a shell
        _complete(os.environ["COMP_LINE"].split())
    # Where nothing else is arranged, such as before training, SIGTERM ends a command as Ctrl-C does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(run(sys.argv[1:], typed=True))


def run(arguments: Sequence[str], typed: bool = False) -> int:
    """Run one command line; return the exit code: 0 done, 2 error (one line on stderr), 130 interrupted.

    `typed`: a user typed the line, and gets a notice of keys that a later word replaces.
    """
    words = [word for word in arguments if word != "--debug"]
    debug = len(words) < len(arguments)
    try:
        with distinct_notices():
            code = _dispatch(words, debug, typed)
        sys.stdout.flush()  # a closed pipe or full disk raises here, inside the try block
        return code
    except BaseException as error:
        if isinstance(error, BrokenPipeError) and _only_prints(words):  # `headway runs | head`
            silence(sys.stdout)
            silence(sys.stderr)
            return 0
        if debug:
            raise
        if isinstance(error, OSError):
            silence(sys.stdout)
        print_line(f"headway: {_line_of(error)}")
        return 130 if isinstance(error, KeyboardInterrupt) else 2


def _line_of(error: BaseException) -> str:
    text = " ".join(str(error).split())
    match error:
        case HeadwayError() | EnvironmentRaisedError():
            return text
        case KeyboardInterrupt():
            return "stopped"
        case SystemExit():  # not of Headway's own code
            return f"{exit_of_environment(error)} (--debug shows where)"
        case MemoryError():
            return one_line(error)
        case _:
            return f"unexpected {type(error).__name__}: {text} (--debug shows where)"


def _complete(words: Sequence[str]) -> None:
    """Print the completions of the last word and exit."""
    from headway_launch.commands.completion import CompletionParser, complete

    parser = CompletionParser("headway")
    parser.add_argument("--version", action="store_true", help="show the version")
    _add_commands(parser, COMMANDS, words)
    complete(parser)


def _add_commands(
    parser: argparse.ArgumentParser, commands: Mapping[str, Command], words: Sequence[str]
) -> None:
    """Add the commands of a group as subparsers, with the arguments of those among `words`."""
    subparsers = parser.add_subparsers()
    for name, command in commands.items():
        of_command = subparsers.add_parser(name, help=command.summary)
        of_command.add_argument("--debug", action="store_true", help="show the traceback of an error")
        if name in words and command.parts:
            _add_commands(of_command, command.parts, words)
        elif name in words:
            _module_of(command).add_arguments(of_command)


def _only_prints(words: Sequence[str]) -> bool:
    command = COMMANDS.get(words[0]) if words else None
    if command is not None and len(words) > 1:
        command = command.parts.get(words[1], command)
    return command is None or command.only_prints or not {"-h", "--help", "--dry-run"}.isdisjoint(words)


def _dispatch(words: Sequence[str], debug: bool, typed: bool) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        parser = _group_parser("headway", _ABOUT, COMMANDS, _EXAMPLES)
        parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
        parser.add_argument("--version", action="store_true", help="show the version")
        parser.print_help()
        return 0
    if words[0] == "--version":
        from importlib.metadata import version

        print(f"headway {version('headway')}")
        return 0
    name = words[0]
    if name.startswith("-"):
        raise HeadwayError(f"{name} comes before the command; write headway COMMAND {name} ...")
    if name not in COMMANDS:
        raise HeadwayError(f"unknown command {name!r}; {suggestion(name, COMMANDS, 'headway ')}")
    command = COMMANDS[name]
    rest = words[1:]
    if command.parts:
        if not rest or rest[0] in ("-h", "--help", "help"):
            examples = _module_of(command).EXAMPLES
            _group_parser(f"headway {name}", _description(command), command.parts, examples).print_help()
            return 0
        if rest[0] not in command.parts:
            fix = suggestion(rest[0], command.parts, f"headway {name} ")
            raise HeadwayError(f"unknown command {rest[0]!r} of headway {name}; {fix}")
        name, command, rest = f"{name} {rest[0]}", command.parts[rest[0]], rest[1:]
    if name in _ONE_THREAD:
        limit_threads()
    module = _module_of(command)
    parser = _Parser(
        rest,
        prog=f"headway {name}",
        description=_description(command),
        epilog=module.EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(parser)
    try:
        parsed = parser.parse_intermixed_args(rest)
    except SystemExit as done:  # --help
        return int(done.code or 0)
    if typed and (overrides := getattr(parsed, "overrides", ())):
        from headway_launch.experiments.experiment_file import split_experiment_file
        from headway_launch.experiments.override_words import replaced_words

        split_experiment_file(overrides)  # refuses a second experiment
        for first, last in replaced_words(overrides):
            print_line(f"headway: {last} replaces {first}")
    parsed.command, parsed.debug, parsed.typed = name, debug, rest
    code: int
    with ExitStack() as opened:
        if (folder := getattr(parsed, "config_dir", None)) is not None:
            from headway_launch.experiments.options import own_configs

            opened.enter_context(own_configs(folder))
        if (file := getattr(parsed, "archive", None)) is not None:
            from headway.store.archive.container import unpacked

            parsed.store = str(opened.enter_context(unpacked(Path(file)))[0])
        code = module.execute(parsed)
    return code


def _module_of(command: Command) -> ModuleType:
    return import_module(f"headway_launch.commands.{command.module}")


def _description(command: Command) -> str:
    return command.summary[0].upper() + command.summary[1:] + "."


def _group_parser(
    name: str, description: str, commands: Mapping[str, Command], examples: str
) -> argparse.ArgumentParser:
    """Return the parser that shows the help of a group of commands."""
    listed = "".join(f"  {each:<11}{command.summary}\n" for each, command in commands.items())
    return argparse.ArgumentParser(
        prog=name,
        usage=f"{name} COMMAND ...",
        description=description,
        epilog=f"commands:\n{listed}\n{examples}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
