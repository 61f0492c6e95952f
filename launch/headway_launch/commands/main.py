"""The `headway` command. Nothing heavy is imported before a command needs it."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import NoReturn, Protocol, cast

from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError
from headway_launch.console.output import print_line, silence

_EXAMPLES = """\
examples:
  headway list experiments
  headway run experiment=bus_mappo seed=0..4 algo.lr=3e-4
  headway runs
  headway browse

headway COMMAND --help shows more. Errors are one line; --debug adds the traceback.
"""


@dataclass(frozen=True)
class _Command:
    summary: str
    module: str
    only_prints: bool = True
    """Nothing is left to do once its reader has gone; False for what trains."""
    parts: "Mapping[str, _Command]" = field(default_factory=dict)
    """Commands of a second word; then `module` is a package with EXAMPLES."""


class _CommandModule(Protocol):
    """What a module of `headway_launch.commands` defines."""

    EXAMPLES: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None: ...

    def execute(self, arguments: argparse.Namespace) -> int:
        """Do it; returns the exit code."""
        ...


_COMMANDS = {
    "run": _Command("train an experiment, all its seeds", "run", only_prints=False),
    "sweep": _Command("train many cells and seeds, as far as the store has not", "sweep", only_prints=False),
    "search": _Command(
        "search for hyper-parameters by a committed configuration", "search", only_prints=False
    ),
    "resume": _Command("go on with runs that were stopped, killed or failed", "resume", only_prints=False),
    "runs": _Command("table of the runs in the store", "runs"),
    "diff": _Command("two runs beside each other: settings and figures that differ", "diff"),
    "evaluate": _Command("play a trained policy beside the classical rules", "evaluate"),
    "compare": _Command("all of a study and the rules on the same days, with intervals", "compare"),
    "plot": _Command("picture of a study's learning curves", "plot"),
    "render": _Command("picture or moving picture of an episode, by a policy or a rule", "render"),
    "report": _Command("a whole study as one page, with tables and pictures", "report"),
    "browse": _Command("browse the store in MLflow's pages", "browse"),
    "sync": _Command("bring MLflow up to date with the run folders", "sync"),
    "data": _Command(
        "scenarios of the bus environment: made, described, drawn and held to what was measured",
        "data",
        parts={
            "synthetic": _Command("write a scenario of a seed and fitted numbers", "data.synthetic"),
            "gtfs": _Command("write a scenario of any GTFS feed", "data.gtfs"),
            "sunt": _Command("write a scenario of raw files of SUNT", "data.sunt"),
            "describe": _Command("lines, fleet, headways and demand of a scenario", "data.describe"),
            "plot": _Command("map of a scenario with load and headways", "data.plot"),
            "realism": _Command("the simulator's days beside what was measured", "data.realism"),
        },
    ),
    "list": _Command("environments, algorithms, wrappers, rules, experiments, presets, keys", "listing"),
}


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise HeadwayError(f"{message}; see {self.prog} --help")


def main() -> None:
    """Entry point of the `headway` script: runs the command line and exits with its code."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> int:
    """Run one command line; returns its exit code: 0 done, 2 an error (one line on stderr), 130 stopped."""
    words = [word for word in arguments if word != "--debug"]
    debug = len(words) < len(arguments)
    try:
        code = _dispatch(words, debug)
        sys.stdout.flush()  # here, where a reader that has gone, or a full disk, can still be answered
        return code
    except HeadwayError as error:
        if debug:
            raise
        print_line(f"headway: {' '.join(str(error).split())}")
        return 2
    except KeyboardInterrupt:
        if debug:
            raise
        print_line("headway: stopped")
        return 130
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _only_prints(words):  # `headway runs | head`
            silence(sys.stdout)
            silence(sys.stderr)
            return 0
        if debug:
            raise
        text = " ".join(str(error).split())
        if isinstance(error, OSError):
            silence(sys.stdout)
        print_line(f"headway: unexpected {type(error).__name__}: {text} (--debug shows where)")
        return 2


def _only_prints(words: Sequence[str]) -> bool:
    command = _COMMANDS.get(words[0]) if words else None
    if command is not None and len(words) > 1:
        command = command.parts.get(words[1], command)
    return command is None or command.only_prints or not {"-h", "--help", "--dry-run"}.isdisjoint(words)


def _dispatch(words: Sequence[str], debug: bool) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        _top_parser().print_help()
        return 0
    if words[0] == "--version":
        from importlib.metadata import version

        print(f"headway {version('headway')}")
        return 0
    name = words[0]
    if name not in _COMMANDS:
        raise HeadwayError(f"{name!r} is no command; {suggestion(name, _COMMANDS, 'headway ')}")
    command = _COMMANDS[name]
    rest = words[1:]
    if command.parts:
        if not rest or rest[0] in ("-h", "--help", "help"):
            _parser_of_parts(name, command).print_help()
            return 0
        if rest[0] not in command.parts:
            fix = suggestion(rest[0], command.parts, f"headway {name} ")
            raise HeadwayError(f"{rest[0]!r} is no command of headway {name}; {fix}")
        name, command, rest = f"{name} {rest[0]}", command.parts[rest[0]], rest[1:]
    module = cast(_CommandModule, import_module(f"headway_launch.commands.{command.module}"))
    parser = _Parser(
        prog=f"headway {name}",
        description=command.summary[0].upper() + command.summary[1:] + ".",
        epilog=module.EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(parser)
    try:
        parsed = parser.parse_intermixed_args(rest)
    except SystemExit as done:  # --help
        return int(done.code or 0)
    parsed.command, parsed.debug = name, debug
    return module.execute(parsed)


def _parser_of_parts(name: str, command: _Command) -> argparse.ArgumentParser:
    module = cast(_CommandModule, import_module(f"headway_launch.commands.{command.module}"))
    return argparse.ArgumentParser(
        prog=f"headway {name}",
        usage=f"headway {name} COMMAND ...",
        description=command.summary[0].upper() + command.summary[1:] + ".",
        epilog=_listed(command.parts) + "\n" + module.EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _listed(commands: Mapping[str, _Command]) -> str:
    return "commands:\n" + "".join(f"  {name:<10}{command.summary}\n" for name, command in commands.items())


def _top_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="headway",
        usage="headway COMMAND ...",
        description="Multi-agent reinforcement-learning experiments in transport.",
        epilog=_listed(_COMMANDS) + "\n" + _EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.add_argument("--version", action="store_true", help="show the version")
    return parser
