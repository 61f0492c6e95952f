"""The site's reference, written from the code: environments, algorithms, keys, wrappers, commands and API."""

import inspect
import io
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import MISSING, is_dataclass
from dataclasses import fields as fields_of
from importlib import import_module
from pathlib import Path
from types import ModuleType

from sphinx.pycode import ModuleAnalyzer

from headway.config.experiment import ExperimentConfig
from headway.config.schema import FieldDescription, describe
from headway.contracts import HeadwayError
from headway.registry import algo_entries, env_entries, wrapper_entries
from headway_launch.commands.listing import algorithm_keys, metrics_of, observation_rows, rules_of
from headway_launch.commands.main import COMMANDS, run
from headway_launch.experiments.options import options, summary_of

PACKAGES = ("headway", "headway_envs", "headway_algos", "headway_launch")
_SPECIAL = re.compile(r"([\\*_<\[\]|])")
_HELP_COLUMNS = "88"


def write(folder: Path) -> None:
    """Write all pages as Markdown into `folder`; leave pages that have not changed, and remove others."""
    wanted = {folder / f"{name}.md": text for name, text in _pages().items()}
    for page in set(folder.rglob("*.md")) - set(wanted):
        page.unlink()
    for page, text in wanted.items():
        page.parent.mkdir(parents=True, exist_ok=True)
        if not page.is_file() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def public_name(target: str) -> str | None:
    """Return the public name of an object that a signature names, such as `headway.api.EnvSpec` for
    `headway.contracts.environment.EnvSpec`; None if it has none."""
    name = target.rpartition(".")[2]
    found = [package for package in PACKAGES if name in import_module(f"{package}.api").__all__]
    return f"{found[0]}.api.{name}" if found else None


def _pages() -> dict[str, str]:
    """Return the text of each page by its path without suffix."""
    return {
        "environments/index": _environments(),
        **{f"environments/{name}": _environment(name) for name in env_entries()},
        "algorithms/index": _algorithms(),
        **{f"algorithms/{name}": _algorithm(name) for name in algo_entries()},
        "configuration": _configuration(),
        "options": _options(),
        "wrappers": _wrappers(),
        "commands": _commands(),
        **{f"api/{package}": _api(package) for package in PACKAGES},
    }


def _environments() -> str:
    text = (
        "`env=NAME` chooses one, `env.args.KEY=VALUE` sets an argument. PettingZoo environments need no "
        "entry: `env=mpe2.simple_spread_v3` names the module."
    )
    return _index("Environments", text, {name: entry.summary for name, entry in env_entries().items()})


def _environment(name: str) -> str:
    entry = env_entries()[name]
    rules = {f"`{rule}`": found.summary for rule, found in rules_of(name).items()}
    metrics = {f"`{metric}`": text for metric, text in metrics_of(name).items()}
    described = (Path(__file__).parent / "environments" / f"{name}.md").is_file()
    parts = [
        f"# `{name}`",
        _sentence(entry.summary),
        f"[What agents observe, do and are rewarded for](../../environments/{name}.md)." if described else "",
        "## Arguments",
        _keys(describe(entry.config, "env.args")),
    ]
    parts += [
        "## Observation",
        _observation(name),
        "## Rules",
        "Controllers that do not learn, evaluated beside the learners.",
        _definitions(rules),
    ]
    if metrics:
        parts += ["## Metrics", "Of an episode, in columns such as `evaluation_greedy/return`."]
        parts.append(_definitions(metrics))
    return "\n\n".join(parts)


def _observation(name: str) -> str:
    """Return the table of an observation's numbers with the default arguments."""
    try:
        rows = observation_rows(name)
    except HeadwayError:  # a simulator is not installed
        return f"`headway list observations {name}` prints it."
    lines = [
        f"| {index} | `{term}` | {unit} | {scale} | {_escaped(text)} |"
        for index, term, unit, scale, text in rows
    ]
    return "\n".join(["| index | name | unit | scale | meaning |", "|---:|---|---|---:|---|", *lines])


def _algorithms() -> str:
    text = (
        "`algo=NAME` chooses one, `algo.KEY=VALUE` sets a hyper-parameter; a key that an algorithm does not "
        "read is refused. [Design](../../design/algorithms.md) says how they differ and how they learn."
    )
    return _index("Algorithms", text, {name: entry.summary for name, entry in algo_entries().items()})


def _index(title: str, text: str, summaries: Mapping[str, str]) -> str:
    """Return the page that lists pages of its folder by name."""
    listed = {f"[`{name}`]({name}.md)": summary for name, summary in summaries.items()}
    return f"# {title}\n\n{text}\n\n{_definitions(listed)}\n{_toctree(summaries)}"


def _algorithm(name: str) -> str:
    entry = algo_entries()[name]
    documentation = inspect.getdoc(import_module(f"headway_algos.recipes.{name}")) or ""
    title, _, text = documentation.partition("\n")
    return "\n\n".join(
        [
            f"# `{name}`",
            f"**{title.rstrip('.')}.** {_escaped(_sentence(entry.summary))}",
            f"Source: {entry.source}.",
            _markdown(text.strip()),
            "## Keys",
            _keys(algorithm_keys(name)),
        ]
    )


def _configuration() -> str:
    groups: dict[str, list[FieldDescription]] = {}
    for key in describe(ExperimentConfig):
        groups.setdefault(key.key.partition(".")[0] if "." in key.key else "", []).append(key)
    parts = [
        "# Configuration keys",
        "Keys of an experiment, for a file in `configs/experiment` or as `KEY=VALUE` in a command. "
        "[Configuration](../guide/configuration.md) says which of several values wins. The keys of "
        "`env.args` are those of the [environment](environments/index.md), the other keys of `algo` those of "
        "the [algorithm](algorithms/index.md).",
        _keys(groups.pop("")),
    ]
    for group, keys in groups.items():
        parts += [f"## `{group}`", _keys(keys)]
    return "\n\n".join(parts)


def _options() -> str:
    parts = ["# Experiments, presets and searches", "Files of `configs/`, by name."]
    for group, command in (
        ("experiment", "headway run experiment=NAME"),
        ("preset", "preset=NAME"),
        ("search", "headway search NAME"),
        ("space", "pieces: [NAME]"),
    ):
        listed = {f"`{name}`": summary_of(group, name) for name in options()[group]}
        parts += [f"## {group.capitalize()}", f"`{command}`", _definitions(listed)]
    return "\n\n".join(parts)


def _wrappers() -> str:
    parts = [
        "# Wrappers",
        "`env.wrappers='[{name: frame_stack_v1, stack_size: 4}, clip_reward_v0]'` lists wrappers, the "
        "innermost first. One without a batched form makes a native environment run as its PettingZoo "
        "environment, which is slower.",
    ]
    for name, entry in wrapper_entries().items():
        form = "has a batched form" if entry.batched else "no batched form"
        parts += [
            f"## `{name}`",
            f"{_escaped(_sentence(entry.summary))} ({form})",
            _keys(describe(entry.config)),
        ]
    return "\n\n".join(parts)


def _commands() -> str:
    parts = ["# Commands", "What `headway COMMAND --help` prints."]
    for name, command in COMMANDS.items():
        parts += [f"## headway {name}", _help(name)]
        for part in command.parts:
            parts += [f"### headway {name} {part}", _help(name, part)]
    return "\n\n".join(parts)


def _help(*words: str) -> str:
    shown, before = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = _HELP_COLUMNS
    try:
        with redirect_stdout(shown):
            run([*words, "--help"])
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
    return f"```text\n{shown.getvalue().strip()}\n```"


def _api(package: str) -> str:
    module = import_module(f"{package}.api")
    kinds: Mapping[str, list[str]] = {"Functions": [], "Classes": [], "Values": []}
    parts = [f"# `{module.__name__}`", _markdown(inspect.getdoc(module) or "")]
    modules = []
    for name in sorted(module.__all__):
        member, path = getattr(module, name), f"{module.__name__}.{name}"
        if inspect.ismodule(member):
            modules += [f"## `{name}`", _markdown(inspect.getdoc(member) or ""), _module_functions(member)]
        elif inspect.isclass(member):
            kinds["Classes"].append(_class(path, member))
        elif inspect.isfunction(member):
            kinds["Functions"].append(f".. autofunction:: {path}")
        else:
            kinds["Values"].append(f".. py:data:: {path}\n\n   {_value_doc(package, name)}")
    for kind, directives in kinds.items():
        if directives:
            parts += [f"## {kind}", _directives(directives)]
    return "\n\n".join([*parts, *modules])


def _class(path: str, member: type) -> str:
    """Return the directive of a class. The types of a record's fields are written as in the source."""
    fields = _record_fields(member)
    if not fields:
        return f".. autoclass:: {path}\n   :members:"
    others = {
        name: None
        for base in member.__mro__
        if base.__module__.startswith("headway")
        for name, value in vars(base).items()
        if not name.startswith("_")
        and name not in fields
        and (callable(value) or isinstance(value, property))
    }
    lines = [f".. autoclass:: {path}", *([f"   :members: {', '.join(others)}"] if others else [])]
    for name, default in fields.items():
        kind, documentation = _source_of_field(member, name)
        lines += ["", f"   .. py:attribute:: {path.rpartition('.')[2]}.{name}", f"      :type: {kind}"]
        lines += [f"      :value: {default}"] if default else []
        lines += ["", *(f"      {line}" for line in documentation)]
    return "\n".join(lines)


def _record_fields(member: type) -> dict[str, str]:
    """Return the default of each field of a dataclass or named tuple, as text if it is short; nothing for
    another class."""
    if is_dataclass(member):
        return {field.name: _short(field.default) for field in fields_of(member)}
    defaults: Mapping[str, object] = getattr(member, "_field_defaults", {})
    return {name: _short(defaults.get(name, MISSING)) for name in getattr(member, "_fields", ())}


def _short(default: object) -> str:
    text = "" if default is MISSING else repr(default)
    return text if len(text) < 30 and not text.startswith("<") else ""


def _source_of_field(member: type, name: str) -> tuple[str, list[str]]:
    """Return the annotation of a record's field and the lines of its docstring, as in the source."""
    for base in member.__mro__:
        analyzer = ModuleAnalyzer.for_module(base.__module__)
        documentation = analyzer.find_attr_docs()
        if (annotation := analyzer.annotations.get((base.__qualname__, name))) is not None:
            return annotation.strip("'\""), documentation.get((base.__qualname__, name), [])
    raise LookupError(f"{member} has no annotation of {name}")


def _module_functions(module: ModuleType) -> str:
    own = [
        name
        for name, member in vars(module).items()
        if inspect.isfunction(member)
        and member.__module__.startswith(module.__name__)
        and not name.startswith("_")
    ]
    return _directives(f".. autofunction:: {module.__name__}.{name}" for name in own)


def _value_doc(package: str, name: str) -> str:
    """Return the docstring under a value, in whichever loaded module of the package assigns it."""
    for module in sorted(loaded for loaded in sys.modules if loaded.startswith(f"{package}.")):
        if hasattr(sys.modules[module], name):
            found = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", name))
            if found:
                return " ".join(found).strip()
    return ""


def _keys(keys: Iterable[FieldDescription]) -> str:
    """Return keys as a definition list: key, then type, default and meaning."""
    return _definitions(
        {f"`{key.key}`": f"*{key.type}*, {_default(key)}\\\n  {_escaped(key.doc)}" for key in keys},
        escaped=True,
    )


def _default(key: FieldDescription) -> str:
    return "required" if key.default == "required" else f"default `{key.default or repr('')}`"


def _definitions(described: Mapping[str, str], escaped: bool = False) -> str:
    lines: Iterator[str] = (
        f"{term}\n: {text if escaped else _escaped(_sentence(text))}\n" for term, text in described.items()
    )
    return "\n".join(lines) or "None.\n"


def _directives(directives: Iterable[str]) -> str:
    return "\n\n".join(f"```{{eval-rst}}\n{directive}\n```" for directive in directives)


def _toctree(pages: Iterable[str]) -> str:
    return "\n".join(["```{toctree}", ":hidden:", "", *pages, "```", ""])


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:].rstrip(".") + "."


def _escaped(text: str) -> str:
    """Return text with Markdown's special characters escaped, except within backticks."""
    pieces = re.split(r"(`[^`]*`)", text)
    return "".join(piece if piece.startswith("`") else _SPECIAL.sub(r"\\\1", piece) for piece in pieces)


def _markdown(docstring: str) -> str:
    """Return a docstring as Markdown: text is escaped, indented lines, such as equations, are kept."""
    return "\n".join(line if line.startswith("    ") else _escaped(line) for line in docstring.splitlines())
