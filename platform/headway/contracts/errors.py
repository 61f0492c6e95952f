"""The one error a user is meant to see."""


class HeadwayError(Exception):
    """Something the user can mend. The message is one line that says what is wrong and what to do.

    The command line prints it without a traceback (unless `--debug`) and exits with code 2.
    """
