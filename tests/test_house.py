"""The rules of the house: who may import whom, what must not be shadowed, what stays light."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "headway": ROOT / "platform" / "headway",
    "headway_envs": ROOT / "envs" / "headway_envs",
    "headway_algos": ROOT / "algos" / "headway_algos",
    "headway_launch": ROOT / "launch" / "headway_launch",
}
FILES = sorted(file for folder in PACKAGES.values() for file in folder.rglob("*.py"))
HEAVY = ("torch", "mlflow", "hydra", "omegaconf", "pandas", "numba", "pyarrow", "codecarbon", "matplotlib")


def imports_of(file: Path, lazy: bool = True) -> Iterator[str]:
    """Absolute names of the modules a file imports; `lazy` takes in those inside functions."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
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


@pytest.mark.parametrize(
    "statement",
    [
        "import sys; from headway_launch.commands.main import run; run(['--help'])",
        "import sys; from headway_launch.commands.main import run; run(['run', '--help'])",
        "import sys; from headway_launch.commands.main import run; run(['runs', '--help'])",
        "import sys; from headway_launch.commands.main import run; run(['report', '--help'])",
    ],
)
def test_help_imports_nothing_heavy(statement: str) -> None:
    code = f"{statement}; print([name for name in {HEAVY} if name in sys.modules])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.splitlines()[-1] == "[]"


def test_the_registry_of_algorithms_imports_no_torch() -> None:
    code = "import sys, headway.registry as r; r.algo_entries(); print('torch' in sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "False"
