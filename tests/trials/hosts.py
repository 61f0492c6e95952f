"""Virtual hosts on this machine: network namespaces joined by a link that can be cut."""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

from headway.contracts import HeadwayError

_NAME = "headway-{process}-{place}"
_ADDRESS = "192.0.2.{number}"
"""Addresses of a block reserved for documentation (RFC 5737)."""
_END_S = 30.0


@dataclass(frozen=True)
class Host:
    """A network namespace with an address on the link."""

    name: str
    address: str
    device: str
    """Network device of the link in the namespace."""

    def start(
        self, command: Sequence[str], environment: Mapping[str, str], output: Path, errors: Path
    ) -> "subprocess.Popen[bytes]":
        """Start a command in the namespace, in its own process group. `environment` overrides that of this
        process; output is appended to the files."""
        with output.open("ab") as stdout, errors.open("ab") as stderr:
            return subprocess.Popen(
                ["nsenter", f"--net=/run/netns/{self.name}", *command],
                env={**os.environ, **environment},
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                start_new_session=True,
            )

    def processes(self) -> list[psutil.Process]:
        """Return all processes in the namespace."""
        found = []
        for word in _ip("netns", "pids", self.name).split():
            try:
                found.append(psutil.Process(int(word)))
            except psutil.NoSuchProcess:
                continue
        return found

    def kill(self) -> int:
        """Kill all processes in the namespace, as in a power failure; return their number."""
        killed: set[psutil.Process] = set()
        deadline = time.monotonic() + _END_S
        while alive := [process for process in self.processes() if process.is_running()]:
            if time.monotonic() > deadline:
                raise HeadwayError(f"{len(alive)} processes in {self.name} do not end")
            for process in alive:
                killed.add(process)
                try:
                    process.send_signal(signal.SIGKILL)
                except psutil.NoSuchProcess:
                    continue
            psutil.wait_procs(alive, timeout=1.0)
        return len(killed)

    def cut_off(self) -> None:
        """Take the link down; processes in the namespace continue."""
        _ip("-n", self.name, "link", "set", self.device, "down")


@contextmanager
def two_hosts() -> Iterator[tuple[Host, Host]]:
    """Create two linked hosts, and remove them with all their processes at the end.

    Raises HeadwayError, in one line, if namespaces cannot be created.
    """
    if shutil.which("ip") is None:
        raise HeadwayError(
            "network namespaces need the program ip, which is not installed: apt-get install iproute2"
        )
    _remove_left_hosts()
    hosts = [_host(number) for number in (1, 2)]
    try:
        for host in hosts:
            _ip("netns", "add", host.name)
        one, other = hosts
        _ip(
            *("link", "add", one.device, "netns", one.name, "type", "veth"),
            *("peer", "name", other.device, "netns", other.name),
        )
        for host in hosts:
            _ip("-n", host.name, "address", "add", f"{host.address}/24", "dev", host.device)
            for device in ("lo", host.device):
                _ip("-n", host.name, "link", "set", device, "up")
        yield one, other
    finally:
        for host in hosts:
            _remove(host.name)


def _host(number: int) -> Host:
    name = _NAME.format(process=os.getpid(), place=number)
    return Host(name, _ADDRESS.format(number=number), "wire")


def _remove_left_hosts() -> None:
    """Remove the namespaces of killed processes."""
    before = _NAME.partition("{")[0]
    for line in _ip("netns", "list").splitlines():
        name = line.split()[0]
        process_id = name.removeprefix(before).partition("-")[0]
        if name.startswith(before) and process_id.isdigit() and not psutil.pid_exists(int(process_id)):
            _remove(name)


def _remove(name: str) -> None:
    if name in _ip("netns", "list").split():
        Host(name, "", "").kill()
        _ip("netns", "delete", name)


def _ip(*words: str) -> str:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        reason = " ".join(done.stderr.split()) or f"code {done.returncode}"
        raise HeadwayError(f"network namespaces cannot be created: ip {' '.join(words)} fails: {reason}")
    return done.stdout
