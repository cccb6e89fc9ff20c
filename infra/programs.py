"""Runs third-party servers in the foreground: find, reserve ports, start, monitor and stop."""

import contextlib
import ctypes
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import NamedTuple

ENDED, BAD_INPUT, CANNOT_START = 1, 2, 3
"""Exit codes: the server exited; a folder or address is invalid; a port is in use or the server is not installed."""
LOOPBACK = "127.0.0.1"
_START_S = 10.0
_STOP_S = 1.5
_POLL_S = 0.25
_PR_SET_PDEATHSIG = 1
_PATH_BESIDE = "/usr/local/sbin:/usr/sbin:/sbin:/opt/homebrew/sbin"


class NotInstalledError(Exception):
    """A program is not installed; the message names the package."""


class PortTakenError(Exception):
    """A port cannot be used."""


class Server(NamedTuple):
    """A server to run."""

    name: str
    """For messages."""
    command: Sequence[str]
    """Program and arguments."""
    host: str
    """The address it listens on."""
    ports: Sequence[int]
    folder: Path | None = None
    """Its working directory; the server needs no access to the folders above."""
    descriptors: Sequence[int] = ()
    """Descriptors of this program that it inherits."""


def find(program: str, *, package: str) -> str:
    """Path of a program; also searches folders of servers that a user's PATH omits.

    Raises:
        NotInstalledError: Not found.
    """
    path = shutil.which(program) or shutil.which(program, path=_PATH_BESIDE)
    if path is None:
        raise NotInstalledError(f"{program} is not installed; on Debian: apt-get install {package}")
    return path


def address(host: str) -> str:
    """The IPv4 address of a host.

    Raises:
        socket.gaierror: It has none.
    """
    return str(socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)[0][4][0])


def free_ports(*addresses: tuple[str, int]) -> list[int]:
    """The ports, with 0 replaced by free ports. All are bound at the same time, so that two zeros give different ports.

    Raises:
        PortTakenError: A port is in use.
    """
    with contextlib.ExitStack() as stack:
        sockets: list[socket.socket] = []
        for host, port in addresses:
            try:
                listening_socket = stack.enter_context(socket.socket())
                listening_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                listening_socket.bind((host, port))
                listening_socket.listen()
            except (OSError, OverflowError) as error:
                reason = getattr(error, "strerror", None) or error
                raise PortTakenError(f"cannot listen on {host}:{port}: {reason}") from error
            sockets.append(listening_socket)
        return [listening_socket.getsockname()[1] for listening_socket in sockets]


def explain(error: Exception, *, server: str, host: str, home: Path) -> int:
    """Print why a server cannot be started, with advice; returns the exit code."""
    match error:
        case NotInstalledError():
            text, code = str(error), CANNOT_START
        case PortTakenError():
            text, code = f"{error}; choose another port", CANNOT_START
        case socket.gaierror():
            text, code = f"'{host}' has no IPv4 address, which {server} needs", BAD_INPUT
        case OSError():
            text, code = f"cannot use {error.filename or home}: {error.strerror}", BAD_INPUT
        case _:
            text, code = str(error), BAD_INPUT
    print_error(text)
    return code


def supervise(
    *servers: Server,
    ready: str,
    watched: Path | None = None,
    refresh: Callable[[], None] = lambda: None,
    user: tuple[int, int] | None = None,
) -> int:
    """Run servers until SIGTERM or SIGINT, or until one exits; print ``ready`` once all accept connections.

    Args:
        servers: Each starts once the previous one accepts connections.
        ready: The line to print.
        watched: A file of the servers.
        refresh: Called after each change of the file; an ``OSError`` is printed.
        user: User id and group id of the servers; ``None`` for those of this program.

    Returns:
        The exit code.
    """
    stopping = False
    children: list[subprocess.Popen[bytes]] = []

    def stop(_: int, __: FrameType | None) -> None:
        nonlocal stopping
        stopping = True
        for child in children:
            child.terminate()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    for server in servers:
        children.append(_start(server, user))
        if not _wait_for_ports(server, children[-1], lambda: stopping):
            break
    else:
        print(ready, flush=True)  # noqa: T201 (command-line program)
    stamp = _stamp(watched)
    while not stopping and all(child.poll() is None for child in children):
        with contextlib.suppress(subprocess.TimeoutExpired):
            children[-1].wait(_POLL_S)
        previous, stamp = stamp, _stamp(watched)
        if stamp != previous:
            _refresh(refresh)
    ended = [(server.name, child.returncode) for server, child in zip(servers, children, strict=False)]
    _end(children)
    if stopping:
        return 0
    name, code = next((name, code) for name, code in ended if code is not None)
    print_error(f"{name} exited with code {code}; see its output above")
    return ENDED


def _start(server: Server, user: tuple[int, int] | None) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(  # noqa: S603 (resolved path, generated files)
        server.command,
        cwd=server.folder,
        pass_fds=server.descriptors,
        user=user and user[0],
        group=user and user[1],
        extra_groups=user and [],
        stdin=subprocess.DEVNULL,
        stdout=sys.stderr.fileno(),  # standard output is reserved for the ready line
        preexec_fn=lambda: signal_with_parent(signal.SIGKILL),  # noqa: PLW1509 (single-threaded)
        start_new_session=True,  # Ctrl-C only reaches this program, which stops the server
    )


def _end(children: "Sequence[subprocess.Popen[bytes]]") -> None:
    """End the children; kill those that ignore SIGTERM."""
    kill_at = time.monotonic() + _STOP_S
    for child in children:
        child.terminate()
    for child in children:
        try:
            child.wait(max(0.0, kill_at - time.monotonic()))
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def _refresh(refresh: Callable[[], None]) -> None:
    try:
        refresh()
    except OSError as error:
        print_error(f"cannot read {error.filename}: {error.strerror}; the previous content applies")


def _stamp(path: Path | None) -> tuple[int, int] | None:
    """A value that differs after a change of the file."""
    try:
        stat = path.stat() if path else None
    except OSError:
        return None
    return stat and (stat.st_mtime_ns, stat.st_ino)


def _wait_for_ports(server: Server, child: "subprocess.Popen[bytes]", stopping: Callable[[], bool]) -> bool:
    """Wait until every port accepts a connection, the server has exited, or this program stops."""
    deadline = time.monotonic() + _START_S
    pending = list(server.ports)
    while pending and child.poll() is None and not stopping():
        try:
            socket.create_connection((server.host, pending[0]), timeout=1.0).close()
            del pending[0]
        except OSError:
            if time.monotonic() > deadline:
                print_error(f"{server.name} does not listen on {server.host}:{pending[0]}")
                child.terminate()
                return False
            time.sleep(0.02)
    return not pending


def print_error(text: str) -> None:
    """Print one line about a failure of the server."""
    print(f"broker: {text}", file=sys.stderr)  # noqa: T201 (command-line program)


def signal_with_parent(number: signal.Signals) -> None:
    """Linux, in a new child process: receive a signal when the parent process exits."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
