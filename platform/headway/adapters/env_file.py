"""A Python file of the user's own that defines an environment: `env=./shuttle.py`."""

import hashlib
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

from headway.config.schema import nearest
from headway.contracts.errors import HeadwayError

_DIGITS = 12
"""Digits of `EnvFile.digest`."""


@dataclass(frozen=True)
class EnvFile:
    """The text of a Python file. Picklable: all processes of a session run the text that the session read."""

    path: str
    """Absolute path."""
    source: bytes

    @classmethod
    def read(cls, path: str) -> "EnvFile":
        """Read the file at an absolute path. Raises HeadwayError if it cannot be read."""
        file = Path(path)
        if not file.is_absolute():
            raise HeadwayError(f"env.id={path}: a stored path must be absolute; correct it to use the run")
        if not file.is_file():
            near = nearest(
                file.stem, [beside.stem for beside in file.parent.glob("*.py") if beside.is_file()]
            )
            fix = f"did you mean {near}.py, beside it?" if near else "correct the path, or restore the file"
            raise HeadwayError(f"env.id={path}: there is no such file; {fix}")
        try:
            return cls(path, file.read_bytes())
        except OSError as error:
            raise HeadwayError(f"env.id={path} cannot be read: {error.strerror}") from error

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore from a pickle and load the module, which may define what is unpickled next (rules)."""
        vars(self).update(state)
        self.load()

    @cached_property
    def digest(self) -> str:
        """The first digits of the text's SHA-256."""
        return hashlib.sha256(self.source).hexdigest()[:_DIGITS]

    def load(self) -> ModuleType:
        """Execute the file's text, once per process, and return the module. Exceptions raised by the text
        propagate.

        The file's folder is appended to `sys.path`, so that the file can import its neighbours. For a file of
        a package, the folder that contains the package is appended instead, and relative imports work.
        """
        folder = Path(self.path).parent
        package: list[str] = []
        while (folder / "__init__.py").is_file():
            package.insert(0, folder.name)
            folder = folder.parent
        # Part of the name is the text, so that a notebook sees a file that was edited since the last run.
        name = f"{Path(self.path).stem}_{hashlib.sha256(self.path.encode()).hexdigest()[:6]}_{self.digest}"
        if name in sys.modules:
            return sys.modules[name]
        if str(folder) not in sys.path:
            sys.path.append(str(folder))
        module = ModuleType(name)
        module.__file__, module.__package__ = self.path, ".".join(package)
        sys.modules[name] = module  # dataclasses look their module up
        try:
            exec(compile(self.source, self.path, "exec"), vars(module))
        except BaseException:
            del sys.modules[name]
            raise
        return module


def is_file_id(env_id: str) -> bool:
    """Return whether an environment's id is the path of a Python file."""
    return env_id.endswith(".py")


def absolute_id(env_id: str) -> str:
    """Return an environment's id; the path of a file is made absolute, from the current folder."""
    return str(Path(env_id).resolve()) if is_file_id(env_id) else env_id
