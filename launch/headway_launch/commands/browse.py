"""`headway browse`: serve the pages of the store on this machine."""

import argparse
import socket
import time
from contextlib import closing
from errno import EADDRINUSE
from importlib.metadata import PackageNotFoundError, version
from threading import Thread

from headway.contracts.errors import HeadwayError
from headway_launch.commands.arguments import add_store_argument, existing_store
from headway_launch.console.output import print_line
from headway_launch.runner.scheduler import StopRequests

EXAMPLES = """\
examples:
  headway browse
  headway browse --port 5050 --store runs

Serves the studies, their reports and, in MLflow, their runs, read-only. The printed address has a token;
without it, other users of the machine are refused. To read the pages on another machine, forward the port,
ssh -L 5000:127.0.0.1:5000 MACHINE, and open the printed address there.
"""

_HOST = "127.0.0.1"
_FIRST_UPDATE_S = 3.0
"""Seconds to wait for MLflow's database to be brought up to date; that of a large study takes longer."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the port and the store."""
    parser.add_argument("--port", type=int, default=5000, help="port on 127.0.0.1 (default: 5000)")
    add_store_argument(parser, archives=False)


def execute(arguments: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    _require_mlflow()
    root = existing_store(arguments.store).resolve()
    with closing(_listen(arguments.port)) as listener:
        from werkzeug.serving import WSGIRequestHandler, make_server

        from headway_launch.web.access import TokenAccess
        from headway_launch.web.database_updates import DatabaseUpdates
        from headway_launch.web.pages import Pages

        class Handler(WSGIRequestHandler):
            timeout = 60.0

            def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
                """Print nothing; errors are still printed."""

        updates = DatabaseUpdates(root)
        application = TokenAccess(Pages(root, lambda: updates.has_views))
        server = make_server(
            _HOST,
            arguments.port,
            application,
            threaded=True,
            request_handler=Handler,
            fd=listener.fileno(),
        )
        with StopRequests() as requests:
            updates.start(_FIRST_UPDATE_S)
            Thread(target=server.serve_forever, daemon=True).start()
            print(f"http://{_HOST}:{arguments.port}/?token={application.token}", flush=True)
            print_line("headway: open this address; other users are refused without its token. Ctrl-C stops")
            while not requests.count:
                time.sleep(0.2)
            server.shutdown()
    return 0


def _require_mlflow() -> None:
    """Raise HeadwayError if MLflow's UI is not installed: the light MLflow that the store needs lacks it."""
    try:
        version("mlflow")
    except PackageNotFoundError:
        raise HeadwayError(
            'headway browse needs the whole of MLflow, which is an extra: pip install "headway[browse]"'
        ) from None


def _listen(port: int) -> socket.socket:
    if not 1 <= port < 2**16:
        raise HeadwayError(f"{port} is not a valid port; give one from 1 to 65535, such as --port 5000")
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((_HOST, port))
        listener.listen(128)
    except OSError as error:
        listener.close()
        cause = "; another headway browse may be running" if error.errno == EADDRINUSE else ""
        raise HeadwayError(
            f"port {port} cannot be used ({error}{cause}); give another with --port"
        ) from error
    return listener
