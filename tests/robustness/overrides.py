"""Arguments of commands, right and wrong, generated and shrunk by Hypothesis. Nothing trains."""

import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from headway.config.experiment import ExperimentConfig
from headway.config.schema import FieldDescription, describe
from headway.registry import algo_entries, env_entries, wrapper_entries
from headway_launch.experiments.options import options
from headway_launch.runner.calibration import Pace
from headway_launch.runner.cores import CoreShares
from headway_launch.runner.jobs import CellPlan
from tests.robustness.forked import run_forked
from tests.robustness.outcomes import FAILURES, Ended, Outcome, Scale, Tally, outcome_of, signature_of

Words = tuple[str, ...]
SECONDS = 120.0
"""Bound of one command line."""
_PACE = Pace(0.0, start_s=1, evaluation_s=1, cpu_start_s=1, marks=[(1, 1)] * 3)

_WHOLE = ("0", "1", "-1", "7", "1e3", "1.5", str(2**31), str(2**63 - 1), str(2**63), "1" * 400, "1_0", "0x1")
_NUMBERS = ("0", "0.5", "-0.0", "1e308", "1e400", "5e-324", "nan", "inf", "-inf", ".5", "1" * 400)
_TEXTS = (
    "", "''", '""', "a", "null", "'null'", "é", "日本", "a b", "/", "..", "~", "/dev/zero", "x" * 5000,
    "\x1b[31m", "\r", "a\nb", "\u202e", "\udcff", "-", "--", "%s", "{}", "None",
)  # fmt: skip
_NESTED = (
    "[]", "{}", "[[]]", "[null]", "{a: 1}", "{a: {b: [1, {c: null}]}}", "{1: 2}", "{null: 1}",
    "{_target_: os.system}", "[" * 50 + "]" * 50, "[" * 3000, "{a: " * 300, "[nan]", "[1, a, true]",
    "[0, 0]", "{a: 1, a: 2}", "[-1]",
)  # fmt: skip
_INTERPOLATIONS = (
    "${seed}", "${nothing}", "${env.id}", "${oc.env:HOME}", "${project:.}", "${", "${a:${b}}",
    "${oc.decode:'['}", "${..seed}", "${hydra:runtime.cwd}", "\\${seed}", "???", "${study}", "${env}",
)  # fmt: skip
_SWEEPS = (
    "1,2", "a,b", "choice(1,2)", "choice()", "range(0,3)", "range(3,0)", "range(0,1,0)", "interval(0,1)",
    "glob(*)", "glob([a*,b])", "glob()", "sort(2,1)", "shuffle(1,2)", "tag(a,choice(1,2))", "int(1.5)",
    "int(a)", "float(nan)", "str([1])", "bool(2)", "json_str({a:1})", "extend_list(1)", "0..4", "4..0",
    "0..999999999", "range(0,9999999)", "choice(1,2", "cast(1)",
)  # fmt: skip
_PIECES = (
    *"[]{}()=,:;'\"\\$*+~.#&|!?@% \n\t", "${", "..", "choice(", "range(", "glob(", "1", "a", "null", "true",
    "1e9", "nan", "seed", "env.args", "é",
)  # fmt: skip
_PREFIXES = ("", "", "", "", "+", "++", "~", "~~", "+~", "+++", " ", "@", "-", "--")
_MODULES = ("mpe2.simple_spread_v3", "mpe2.nothing_v0", "os.path", "nothing.at.all", ".", "a..b", "mpe2.")
_COMMANDS = (
    ("list",), ("runs",), ("report",), ("compare",), ("plot",), ("diff",), ("evaluate",), ("resume",),
    ("render",), ("data", "describe"), ("data", "plot"), ("data",), ("nothing",),
)  # fmt: skip
_FLAGS = (
    "--study", "--where", "--sort", "--format", "--seed", "--metric", "--low", "--episodes", "--rules",
    "--against", "--status", "--store", "--fresh", "--nothing", "--help", "-x", "--", "--seed=-1",
    "--day-type", "--rule", "--fps",
)  # fmt: skip
_ARGUMENTS = (
    "envs", "algos", "keys", "rules", "metrics", "wrappers", "presets", "bus", "trivial", "line",
    "reward>3", "a desc", "seed==1", "((", "1/0", "seed in [1]", "' or 1=1", "env=trivial", "env=nothing",
    "seed", "tracking", "matrix",
)  # fmt: skip


def command_lines() -> SearchStrategy[Words]:
    """Command lines of which none trains or writes outside its working directory."""
    return st.one_of(_runs(), _runs(), _runs(), _other_commands())


@st.composite
def _runs(draw: st.DrawFn) -> Words:
    env = draw(st.sampled_from(sorted(env_entries())))
    algo = draw(st.one_of(st.just("ippo"), st.sampled_from(sorted(algo_entries()))))  # ippo runs on all
    named = st.just((f"env={env}", f"algo={algo}"))
    base = draw(
        st.one_of(
            *[named] * 4,
            st.sampled_from(options()["experiment"]).map(lambda name: (f"experiment={name}",)),
            st.just(()),
        )
    )
    given_ones = draw(st.lists(_override(env, algo), min_size=1, max_size=3))
    words = (*base, *given_ones)
    if draw(st.booleans()):
        words = tuple(draw(st.permutations(words)))
    return (draw(st.sampled_from(("run", "run", "sweep"))), *words, "--dry-run")


def _other_commands() -> SearchStrategy[Words]:
    word = st.one_of(
        st.sampled_from(_ARGUMENTS), st.sampled_from(_FLAGS), _value("text"), _override("trivial", "ippo")
    )
    return st.builds(
        lambda command, words: (*command, *words), st.sampled_from(_COMMANDS), st.lists(word, max_size=4)
    )


def _override(env: str, algo: str) -> SearchStrategy[str]:
    keys = {
        **_keys(ExperimentConfig),
        **_keys(env_entries()[env].config, "env.args"),
        **_keys(algo_entries()[algo].config, "algo"),
    }
    key = st.sampled_from(sorted(keys))
    known = key.flatmap(
        lambda name: st.builds(f"{name}={{}}".format, _value(keys[name].type, keys[name].default))
    )
    training = known.map(lambda text: text.replace("env.args", "env.training_args"))
    wrong = st.builds("{}{}={}".format, st.sampled_from(_PREFIXES), key.flatmap(_misspelt), _value("text"))
    prefixed = st.builds("{}{}".format, st.sampled_from(_PREFIXES), known)
    deleted = st.builds("{}{}".format, st.sampled_from(("~", "~", "+", "")), key)
    return st.one_of(
        known, known, known, known, training, prefixed, wrong, deleted, _choice(), _wrappers(), _junk()
    )


def _keys(record: type, path: str = "") -> dict[str, FieldDescription]:
    return {row.key: row for row in describe(record, path)}


def _misspelt(key: str) -> SearchStrategy[str]:
    places = st.integers(0, len(key) - 1)
    return st.one_of(
        places.map(lambda place: key[:place] + key[place + 1 :]),
        places.map(lambda place: key[:place] + "." + key[place:]),
        st.builds(lambda place, text: key[:place] + text + key[place:], places, _junk()),
        st.sampled_from(
            (key.upper(), key.rpartition(".")[2], key.partition(".")[0], f"{key}.more", f"hydra.{key}")
        ),
    )


def _choice() -> SearchStrategy[str]:
    """A choice of a group, or nearly."""
    groups = options()

    def of_group(group: str) -> SearchStrategy[str]:
        right = st.sampled_from(groups[group])
        wrong = st.one_of(
            right.flatmap(_misspelt), st.sampled_from(_MODULES), st.sampled_from(_SWEEPS), _junk()
        )
        return st.builds(f"{group}={{}}".format, st.one_of(right, wrong))

    return st.sampled_from(sorted(groups)).flatmap(of_group)


def _wrappers() -> SearchStrategy[str]:
    known = {name: _keys(entry.config) for name, entry in wrapper_entries().items()}

    def wrapper(name: str) -> SearchStrategy[str]:
        arguments = [
            st.builds(f"{key}: {{}}".format, _value(row.type, row.default, depth=0))
            for key, row in known[name].items()
        ]
        some = st.lists(st.one_of(arguments), max_size=3) if arguments else st.just([])
        return st.one_of(
            st.just(name), some.map(lambda given: "{" + ", ".join([f"name: {name}", *given]) + "}")
        )

    each = st.one_of(st.sampled_from(sorted(known)).flatmap(wrapper), _value("text", depth=0))
    return st.lists(each, max_size=3).map(lambda listed: f"env.wrappers=[{', '.join(listed)}]")


def _value(kind: str, default: str = "required", depth: int = 1) -> SearchStrategy[str]:
    """A value for a key of a type in words, as `describe` gives it: mostly of that type, often odd."""
    fitting = [] if default == "required" else [default, default]
    if "number" in kind:
        fitting += ("1", "2", "8", "16") if "whole" in kind else ("0.5", "1", "0.001")
    if "one of" in kind:
        fitting += kind.partition("one of ")[2].replace(" or null", "").split(", ")
    if "true" in kind:
        fitting += ("true", "false")
    if "null" in kind:
        fitting.append("null")
    edges = [*_WHOLE, *_NUMBERS] if "number" in kind else _TEXTS
    right, edge = st.sampled_from(fitting or ["a"]), st.sampled_from(edges)
    if "list" in kind:
        edge = st.lists(edge, max_size=3).map(lambda items: f"[{','.join(items)}]")
    odd = st.sampled_from((*_TEXTS, *_WHOLE, *_NUMBERS, *_NESTED, *_INTERPOLATIONS, *_SWEEPS))
    choices = [right] * 6 + [edge, edge, odd, _junk()]
    if depth:
        forms = st.sampled_from(("'{}'", "[{}]", "{{a: {}}}", '"{}"'))
        inner = _value(kind, default, depth - 1)
        choices.append(forms.flatmap(lambda form: inner.map(form.format)))
    return st.one_of(choices)


def _junk() -> SearchStrategy[str]:
    anything = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8)
    return st.one_of(st.lists(st.sampled_from(_PIECES), max_size=8).map("".join), anything)


def shell_line(words: Sequence[str]) -> str:
    """Return a command line for Bash, with control characters as escapes."""
    return " ".join(["headway", *map(_shell_word, words)])


def _shell_word(word: str) -> str:
    if word.isprintable():
        return shlex.quote(word)
    escapes = {ord("'"): "\\'", ord("\\"): "\\\\"}
    text = "".join(
        escapes.get(byte, chr(byte)) if 32 <= byte < 127 else f"\\x{byte:02x}" for byte in os.fsencode(word)
    )
    return f"$'{text}'"


def campaign(scale: Scale, seed: int, folder: Path) -> list[Tally]:
    """Run generated command lines in an empty folder."""
    search = Search(Tally("overrides"), folder)
    with patch("headway_launch.studies.dry_run.calibrate", without_training):
        _warm_up(folder)
        search.run(command_lines(), scale.overrides, seed)
    return [search.tally]


def without_training(cells: Sequence[CellPlan], shares: CoreShares) -> tuple[dict[int, Pace], str]:
    """The calibration of a dry run, without training."""
    return {id(cell): _PACE for cell in cells}, "CPU estimated"


def _warm_up(folder: Path) -> None:
    """Load in this process what most command lines need."""
    from headway_launch.commands.main import run

    for env in env_entries():
        with patch("sys.stdout", Path(os.devnull).open("w")), patch("sys.stderr", Path(os.devnull).open("w")):
            run(["run", f"env={env}", "algo=ippo", f"store.root={folder / 'none'}", "--dry-run"])


class FaultFoundError(AssertionError):
    """A command line failed; raised for Hypothesis, which then shrinks it."""

    def __init__(self, words: Words, ended: Ended) -> None:
        super().__init__(signature_of(ended))
        self.words, self.ended = words, ended


@dataclass
class Search:
    """Search for command lines that fail, each kind of failure shrunk once."""

    tally: Tally
    folder: Path
    execute: Callable[[Sequence[str], Path, float, Path], Ended] = run_forked
    known: set[str] = field(default_factory=set)

    def run(self, lines: SearchStrategy[Words], cases: int, root: int) -> None:
        """Try `cases` command lines. A round ends at a failure of a new kind; the next one ignores it."""
        rounds = 0
        while self.tally.counts.total() < cases and rounds < cases:
            self._round(lines, cases - self.tally.counts.total(), root + rounds)
            rounds += 1

    def _round(self, lines: SearchStrategy[Words], cases: int, root: int) -> None:
        shrinking: list[str] = []

        @seed(root)
        @settings(
            max_examples=cases, database=None, deadline=None, phases=[Phase.generate, Phase.shrink],
            report_multiple_bugs=False, suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        @given(lines)
        def attempt(words: Words) -> None:
            ended = self._ended(words)
            outcome, signature = outcome_of(ended), signature_of(ended)
            new = outcome in FAILURES and signature not in self.known
            if outcome is Outcome.HUNG and new:  # shrinking would take hours
                self.known.add(signature)
                self.tally.add(outcome, shell_line(words))
            elif not shrinking:
                if new:
                    shrinking.append(signature)
                else:
                    self.tally.add(outcome, "")
            if shrinking == [signature] and new:
                raise FaultFoundError(words, ended)

        try:
            attempt()
        except FaultFoundError as found:
            self.known.add(signature_of(found.ended))
            line = found.ended.errors.strip().rpartition("\n")[2]
            self.tally.add(outcome_of(found.ended), f"{shell_line(found.words)}\n    {line[:300]!r}")

    def _ended(self, words: Words) -> Ended:
        empty = self.folder / "empty"
        empty.mkdir(exist_ok=True)
        return self.execute(words, empty, SECONDS, self.folder)
