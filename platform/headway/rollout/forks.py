"""Protection against environments that fork."""

import os


def end_if_forked(process_id: int) -> None:
    """End this process if it is not `process_id`: an environment forked it off.

    It would otherwise run on as a second worker, with the same pipe and the same shared memory.
    """
    if os.getpid() != process_id:
        os._exit(1)
