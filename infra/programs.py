"""Runs third-party servers in the foreground: find, reserve ports, start, monitor and stop."""

import contextlib
import ctypes
import math
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType

ENDED, BAD_INPUT, CANNOT_START = 1, 2, 3
"""Exit codes: the server exited; a folder or address is invalid; a port is in use or the server is not installed."""
_START_S = 10.0
_STOP_S = 1.5
_POLL_S = 0.25
_PR_SET_PDEATHSIG = 1
_PATH_BESIDE = "/usr/local/sbin:/usr/sbin:/sbin:/opt/homebrew/sbin"


class NotInstalledError(Exception):
    """A program is not installed; the message names the package."""


class PortTakenError(Exception):
    """A port cannot be used."""


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


def free_ports(host: str, *ports: int) -> list[int]:
    """The ports, with 0 replaced by free ports. All are bound at the same time, so that two zeros give different ports.

    Raises:
        PortTakenError: A port is in use.
    """
    with contextlib.ExitStack() as stack:
        sockets: list[socket.socket] = []
        for port in ports:
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
    name: str,
    command: Sequence[str],
    *,
    host: str,
    ports: Sequence[int],
    ready: str,
    watched: Path | None = None,
    refresh: Callable[[], None] = lambda: None,
    folder: Path | None = None,
    user: tuple[int, int] | None = None,
) -> int:
    """Run a server until SIGTERM or SIGINT; print ``ready`` once it accepts connections on every port.

    Args:
        name: For messages.
        command: Program and arguments.
        host: The address it listens on.
        ports: Its ports.
        ready: The line to print.
        watched: A file of the server; a change sends SIGHUP to the server.
        refresh: Called before that; an ``OSError`` is printed.
        folder: Its working directory. The server needs no access to the folders above.
        user: User id and group id of the server; ``None`` for those of this program.

    Returns:
        The exit code.
    """
    kill_at = math.inf  # a finite time after the signal that asks this program to stop
    child: subprocess.Popen[bytes] | None = None

    def stop(_: int, __: FrameType | None) -> None:
        nonlocal kill_at
        kill_at = time.monotonic() + _STOP_S
        if child is not None:
            child.terminate()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    child = subprocess.Popen(  # noqa: S603 (resolved path, generated files)
        command,
        cwd=folder,
        user=user and user[0],
        group=user and user[1],
        extra_groups=user and [],
        stdin=subprocess.DEVNULL,
        stdout=sys.stderr.fileno(),  # standard output is reserved for the ready line
        preexec_fn=lambda: signal_with_parent(signal.SIGKILL),  # noqa: PLW1509 (single-threaded)
        start_new_session=True,  # Ctrl-C only reaches this program, which stops the server
    )
    if kill_at < math.inf:
        child.terminate()
    elif _wait_for_ports(name, child, host, ports):
        print(ready, flush=True)  # noqa: T201 (command-line program)
    stamp = _stamp(watched)
    while child.poll() is None:
        # A wait without a timeout would continue after the signal, for as long as the server ignores SIGTERM.
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(_POLL_S)
        previous, stamp = stamp, _stamp(watched)
        if time.monotonic() > kill_at:
            child.kill()
        elif stamp != previous:
            _reload(child, refresh)
    if kill_at < math.inf:
        return 0
    print_error(f"{name} exited with code {child.returncode}; see its output above")
    return ENDED


def _reload(child: "subprocess.Popen[bytes]", refresh: Callable[[], None]) -> None:
    try:
        refresh()
    except OSError as error:
        print_error(f"cannot read {error.filename}: {error.strerror}; the previous content applies")
    else:
        child.send_signal(signal.SIGHUP)


def _stamp(path: Path | None) -> tuple[int, int] | None:
    """A value that differs after a change of the file."""
    try:
        stat = path.stat() if path else None
    except OSError:
        return None
    return stat and (stat.st_mtime_ns, stat.st_ino)


def _wait_for_ports(name: str, child: "subprocess.Popen[bytes]", host: str, ports: Sequence[int]) -> bool:
    """Wait until every port accepts a connection, or the server has exited."""
    deadline = time.monotonic() + _START_S
    pending = list(ports)
    while pending and child.poll() is None:
        try:
            socket.create_connection((host, pending[0]), timeout=1.0).close()
            del pending[0]
        except OSError:
            if time.monotonic() > deadline:
                print_error(f"{name} does not listen on {host}:{pending[0]}")
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
