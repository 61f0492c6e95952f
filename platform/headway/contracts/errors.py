"""The one error a user is meant to see."""


class HeadwayError(Exception):
    """Something the user can mend. The message is one line that says what is wrong and what to do.

    The command line prints it without a traceback (unless `--debug`) and exits with code 2. `details` are
    for who looks further: the traceback of another process, say.
    """

    def __init__(self, line: str, details: str = "") -> None:
        super().__init__(line)
        self.details = details
