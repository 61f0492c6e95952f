"""The rules of the house: who may import whom, what must not be shadowed, what stays light."""

import ast
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache, partial
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import ModuleType

import pytest

import headway.api
import headway_algos.api
import headway_envs.api
import headway_launch.api
from headway.contracts import Lazy, PublishedResults

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "headway": ROOT / "platform" / "headway",
    "headway_envs": ROOT / "envs" / "headway_envs",
    "headway_algos": ROOT / "algos" / "headway_algos",
    "headway_launch": ROOT / "launch" / "headway_launch",
}
FILES = sorted(file for folder in PACKAGES.values() for file in folder.rglob("*.py"))
MODULES = {
    ".".join(file.relative_to(folder.parent).with_suffix("").parts).removesuffix(".__init__"): file
    for folder in PACKAGES.values()
    for file in folder.rglob("*.py")
}
MOST_MODULES = 15
LISTS = ("recipes", "commands")
"""Folders of alike things, which may hold more."""
LAYERS = {
    "headway": (
        "training", "policies", "wrappers", "adapters", "store", "rollout", "energy", "stats", "config",
        "contracts",
    ),
    "headway_algos": (
        "recipes", "on_policy", "off_policy", "optim", "batches", "networks", "acting", "kernels",
    ),
    "headway_launch": ("commands", "web", "report", "studies", "runner", "experiments", "console"),
}  # fmt: skip
"""Folders of a package, from the top: each imports only from those after it."""
TESTS_OF = {
    "platform": "headway", "envs": "headway_envs", "algos": "headway_algos", "launch": "headway_launch",
}  # fmt: skip
HEAVY = (
    "torch", "mlflow", "hydra", "omegaconf", "pandas", "numba", "pyarrow", "codecarbon", "matplotlib",
    "optuna",
)  # fmt: skip


@cache
def _parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def imports_of(file: Path, lazy: bool = True) -> Iterator[str]:
    """Absolute names of the modules a file imports; `lazy` takes in those inside functions."""
    tree = _parsed(file)
    for node in ast.walk(tree) if lazy else _run_at_import(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _run_at_import(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        yield node
        yield from _run_at_import(node)


def package_of(file: Path) -> str:
    return next(name for name, folder in PACKAGES.items() if folder in file.parents)


def test_platform_is_no_package_and_the_standard_library_keeps_its_name() -> None:
    assert not (ROOT / "platform" / "__init__.py").exists()
    code = "import platform, uuid; print(platform.__file__); uuid.uuid4()"
    shown = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert not Path(shown.strip()).is_relative_to(ROOT / "platform")


def test_no_module_has_a_name_of_the_standard_library_or_none_at_all() -> None:
    taken = (sys.stdlib_module_names - {"__init__"}) | {"utils", "helpers", "misc"}
    assert [str(file) for file in FILES if file.stem in taken] == []


def test_tests_are_no_packages() -> None:
    assert not list((ROOT / "tests").rglob("__init__.py"))


def test_imports_obey_the_design() -> None:
    def may(package: str, name: str) -> bool:
        other = name.split(".")[0]
        if package in ("headway_envs", "headway_algos"):
            return other == package or name.startswith("headway.contracts")
        return package == "headway_launch" or other == "headway"

    wrong = [
        f"{file.relative_to(ROOT)} imports {name}"
        for file in FILES
        for name in imports_of(file)
        if name.split(".")[0] in PACKAGES and not may(package_of(file), name)
    ]
    assert wrong == []


def test_only_algorithms_import_torch_before_it_is_needed() -> None:
    wrong = [
        str(file.relative_to(ROOT))
        for file in FILES
        for name in imports_of(file, lazy=False)
        if name.split(".")[0] == "torch" and package_of(file) != "headway_algos"
    ]
    assert wrong == []


def test_help_imports_nothing_heavy() -> None:
    asked = [["--help"], ["run", "--help"], ["runs", "--help"], ["report", "--help"]]
    code = (
        "import sys; from headway_launch.commands.main import run; "
        f"[run(words) for words in {asked}]; print([name for name in {HEAVY} if name in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.splitlines()[-1] == "[]"


def test_the_registries_import_nothing_heavy() -> None:
    code = (
        "import sys, headway.registry as r; r.algo_entries(), r.env_entries(); "
        f"print([name for name in {HEAVY} if name in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"


@cache
def imported_modules(module: str) -> set[str]:
    """Modules of the project that a module imports, those that only type checking needs excepted."""
    found = set()
    for node in _without_type_checking(_parsed(MODULES[module])):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in MODULES else node.module for name in names}
    return (found & set(MODULES)) - {module}


def _without_type_checking(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            yield node
            yield from _without_type_checking(node)


def test_a_folder_holds_no_more_modules_than_are_seen_at_a_glance() -> None:
    counts = Counter(file.parent for file in FILES if file.name != "__init__.py")
    crowded = {
        str(folder.relative_to(ROOT)): count for folder, count in counts.items() if count > MOST_MODULES
    }
    assert {folder for folder in crowded if Path(folder).name not in LISTS} == set()


def test_no_module_imports_itself_by_way_of_others() -> None:
    graph = {module: imported_modules(module) for module in MODULES}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' -> '.join(error.args[1])}")


@pytest.mark.parametrize("package", LAYERS)
def test_folders_import_downwards_only(package: str) -> None:
    layers = LAYERS[package]
    wrong = [
        f"{module} imports {name}"
        for module in MODULES
        for name in imported_modules(module)
        if module.split(".")[0] == name.split(".")[0] == package
        and {(upper := module.split(".")[1]), (lower := name.split(".")[1])} <= set(layers)
        and layers.index(lower) < layers.index(upper)
    ]
    assert wrong == []


def test_tests_lie_in_the_folders_of_what_they_test() -> None:
    wrong = []
    for tests, package in TESTS_OF.items():
        for file in (ROOT / "tests" / tests).rglob("test_*.py"):
            folder = PACKAGES[package] / file.parent.relative_to(ROOT / "tests" / tests)
            if not folder.is_dir():
                wrong.append(str(file.relative_to(ROOT)))
    assert wrong == []


@pytest.mark.parametrize(
    "public", [headway.api, headway_envs.api, headway_algos.api, headway_launch.api], ids=lambda m: m.__name__
)
def test_every_public_name_can_be_imported(public: ModuleType) -> None:
    assert [name for name in public.__all__ if not hasattr(public, name)] == []


def lazy_targets(value: object) -> Iterator[str]:
    """Names that a registry entry loads later, however deep they stand in it."""
    if isinstance(value, Lazy):
        yield value.target
    elif isinstance(value, partial):
        yield from lazy_targets([value.func, *value.args, *value.keywords.values()])
    elif isinstance(value, dict):
        yield from lazy_targets(list(value.values()))
    elif isinstance(value, list):
        for each in value:
            yield from lazy_targets(each)
    elif is_dataclass(value) and not isinstance(value, type):
        yield from lazy_targets([getattr(value, field.name) for field in fields(value)])


def test_every_name_in_the_registries_can_be_loaded() -> None:
    targets = set(lazy_targets([headway_envs.api.ENTRIES, headway_algos.api.ENTRIES]))
    assert len(targets) > 30
    loaded = {target: Lazy(target).load() for target in targets}
    results = {target for target, value in loaded.items() if isinstance(value, PublishedResults)}
    assert len(results) == 4
    assert [target for target in targets - results if not callable(loaded[target])] == []


def test_what_commands_write_into_the_current_folder_by_default_is_ignored() -> None:
    names = [
        "bus.png",
        "bus.gif",
        "RUN.npz",
        "RUN.onnx",
        "RUN.pt",
        "bus.zip",
        "report-bus/report.html",
        "csv-bus/a",
    ]
    ignored = subprocess.run(["git", "check-ignore", *names], cwd=ROOT, capture_output=True, text=True)
    assert ignored.stdout.split() == names


def example_code() -> Iterator[tuple[str, str]]:
    """Each Python example of guides and notebooks: the file that it stands in, and its text."""
    names = subprocess.run(
        ["git", "ls-files", "*.md", "*.ipynb"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    for name in names:
        text = (ROOT / name).read_text(encoding="utf-8")
        if name.endswith(".ipynb"):
            cells = json.loads(text)["cells"]
            yield from ((name, "".join(cell["source"])) for cell in cells if cell["cell_type"] == "code")
        else:
            yield name, text


def test_guides_and_notebooks_import_only_public_modules() -> None:
    public = {f"{package}.api" for package in PACKAGES}
    imports = re.compile(r"^\s*(?:from|import) (headway\w*(?:\.\w+)*)", re.MULTILINE)
    found = [(name, module) for name, code in example_code() for module in imports.findall(code)]
    assert len(found) > 10
    assert [(name, module) for name, module in found if module not in public] == []
