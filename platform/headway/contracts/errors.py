"""The error types that users see."""

import traceback
from pathlib import Path


class HeadwayError(Exception):
    """An error that the user can fix. Its message is one line: what is wrong and what to do.

    The command line prints the line without a traceback (unless `--debug`) and exits with code 2. `details`
    holds longer text for debugging, such as the traceback of another process.
    """

    def __init__(self, line: str, details: str = "") -> None:
        super().__init__(line)
        self.details = details


class WorkersLostError(HeadwayError):
    """Rollout workers, or the cluster that they run on, are gone or cannot be reached."""


class EnvironmentRaisedError(Exception):
    """An exception of an environment's own code, with the environment, the call and the line of code."""

    def __init__(self, environment: str, call: str, error: Exception) -> None:
        """`call`: name of the environment's method; `error`: the exception, with its traceback."""
        frames = traceback.extract_tb(error.__traceback__)[1:]  # without the caller of the environment
        own = [frame for frame in frames if "site-packages" not in frame.filename] or frames
        place = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
        super().__init__(f"environment '{environment}' raised {one_line(error)} in {call}{place}")


def one_line(error: BaseException) -> str:
    """Return `TYPE: first line of the message`; the message alone of errors that Headway words.

    Python raises a MemoryError without a message, so it gets one.
    """
    try:
        text = str(error)
    except Exception:  # of an environment's own class
        text = "its message cannot be read"
    if isinstance(error, HeadwayError | EnvironmentRaisedError):
        return text
    if isinstance(error, MemoryError):
        wanted = f" ({' '.join(text.split())})" if text else ""
        return (
            f"MemoryError: this needs more memory than is free{wanted}; lower sizes, such as rollout.copies, "
            "rollout.steps, backend.stack or the environment's own"
        )
    return f"{type(error).__name__}: {text}".splitlines()[0]


class InvalidValueError(ValueError):
    """A value that a configuration record rejects. The message consists of `key` and `problem`.

    `key`: the field, with dots if it belongs to a nested record (`model.core`). `problem`: the rest of the
    sentence, such as "must be above 0".
    """

    def __init__(self, key: str, problem: str) -> None:
        super().__init__(f"{key} {problem}")
        self.key, self.problem = key, problem


class UnknownKeyError(HeadwayError):
    """A key that a configuration does not have.

    `key`: its full name; `owner`: the configuration's name in the message; `hint`: what to do.
    """

    def __init__(self, key: str, owner: str, hint: str) -> None:
        super().__init__(f"{key} is not a key of {owner}; {hint}")
        self.key = key
