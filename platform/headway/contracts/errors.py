"""The error type that users see."""


class HeadwayError(Exception):
    """An error that the user can fix. Its message is one line: what is wrong and what to do.

    The command line prints the line without a traceback (unless `--debug`) and exits with code 2. `details`
    holds longer text for debugging, such as the traceback of another process.
    """

    def __init__(self, line: str, details: str = "") -> None:
        super().__init__(line)
        self.details = details
