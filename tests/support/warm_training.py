"""Training processes that begin warm: forked from a server that has imported torch and Headway and loaded the
algorithms' kernels; their workers are forked from the same server.

A session starts each training process anew, which takes two seconds of imports. Tests that run many small
sessions in their own process use the server instead; whole sessions in processes of their own
(`python -m headway_launch`) keep the real start.
"""

import os
from multiprocessing import context, forkserver, popen_forkserver
from multiprocessing.process import BaseProcess
from unittest.mock import patch

_MODULES = (
    "headway_launch.runner.training_process", "headway.training.loop", "headway.training.modes",
    "headway_algos.registry", "headway_algos.on_policy.learner", "headway_algos.off_policy.learner",
    "pyarrow.parquet", "loaded_kernels",
)  # fmt: skip
_SERVERS: dict[int, forkserver.ForkServer] = {}
"""Servers by process ID: children never use their parent's."""


def _server() -> forkserver.ForkServer:
    """Return this process's server, distinct from the one of rollout workers, which never import torch."""
    if os.getpid() not in _SERVERS:
        _SERVERS[os.getpid()] = forkserver.ForkServer()
        _SERVERS[os.getpid()].set_forkserver_preload(list(_MODULES))
    return _SERVERS[os.getpid()]


class _Popen(popen_forkserver.Popen):
    def _launch(self, process_obj: BaseProcess) -> None:
        with patch.object(forkserver, "connect_to_new_process", _server().connect_to_new_process):
            super()._launch(process_obj)


class WarmProcess(context.ForkServerProcess):
    """A process of the server."""

    @staticmethod
    def _Popen(process_obj: BaseProcess) -> popen_forkserver.Popen:  # noqa: N802 - multiprocessing's name
        return _Popen(process_obj)


class WarmContext(context.ForkServerContext):
    """The session's replacement for `multiprocessing.get_context`."""

    Process = WarmProcess
