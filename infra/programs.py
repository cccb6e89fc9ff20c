"""Programs from outside that are run in the foreground: found, given ports, started, watched and ended in order."""

import contextlib
import ctypes
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

ENDED, BAD_INPUT, CANNOT_START = 1, 2, 3
"""Exit codes: it ended by itself; a folder or address cannot be used; a port is taken or it is not installed."""
_START_S = 10.0
_STOP_S = 1.5
_LOOK_S = 0.25
_PR_SET_PDEATHSIG = 1
_PATH_BESIDE = "/usr/local/sbin:/usr/sbin:/sbin:/opt/homebrew/sbin"


class NotInstalledError(Exception):
    """A program is not on this machine; the text names the package."""


class PortTakenError(Exception):
    """A port that cannot be listened on."""


def find(program: str, *, package: str) -> str:
    """Path of a program, also where the user's PATH leaves out the folders of servers.

    Raises:
        NotInstalledError: There is none.
    """
    found = shutil.which(program) or shutil.which(program, path=_PATH_BESIDE)
    if found is None:
        raise NotInstalledError(f"{program} is not installed; on Debian: apt-get install {package}")
    return found


def address(host: str) -> str:
    """The IPv4 address of a host.

    Raises:
        socket.gaierror: It has none.
    """
    return str(socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)[0][4][0])


def free_ports(host: str, *ports: int) -> list[int]:
    """The ports, seen to be free. All are held until the last is known, so that two zeros become two ports.

    Raises:
        PortTakenError: One is not.
    """
    with contextlib.ExitStack() as stack:
        held: list[socket.socket] = []
        for port in ports:
            try:
                each = stack.enter_context(socket.socket())
                each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                each.bind((host, port))
                each.listen()
            except (OSError, OverflowError) as error:
                why = getattr(error, "strerror", None) or error
                raise PortTakenError(f"cannot listen on {host}:{port}: {why}") from error
            held.append(each)
        return [each.getsockname()[1] for each in held]


def supervise(
    name: str, command: Sequence[str], *, host: str, ports: Sequence[int], ready: str, watched: Path | None = None
) -> int:
    """Run a server until SIGTERM or SIGINT; prints ``ready`` once it answers on every port; the exit code.

    Args:
        name: For people.
        command: Program and arguments.
        host: The address it listens on.
        ports: Its ports.
        ready: The line to print.
        watched: A file of the server's; when it changes the server is told to read again (SIGHUP).
    """
    stopping = False
    child: subprocess.Popen[bytes] | None = None

    def stop(_: int, __: FrameType | None) -> None:
        nonlocal stopping
        stopping = True
        if child is not None:
            child.terminate()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    child = subprocess.Popen(  # noqa: S603 (a path that was looked up, and files that were written here)
        command,
        stdin=subprocess.DEVNULL,
        stdout=sys.stderr.fileno(),  # our own output is for the line that says it is ready
        preexec_fn=_die_with_parent,  # noqa: PLW1509 (there is one thread)
        start_new_session=True,  # Ctrl-C reaches this program only, which then ends it in order
    )
    if stopping:
        child.terminate()
    elif _answers(name, child, host, ports):
        print(ready, flush=True)  # noqa: T201 (a terminal program prints)
    changes = _Changes(watched)
    while child.poll() is None:
        try:
            child.wait(_STOP_S if stopping else _LOOK_S if watched else None)
        except subprocess.TimeoutExpired:
            if stopping or changes.seen():
                child.send_signal(signal.SIGKILL if stopping else signal.SIGHUP)
    if stopping:
        return 0
    _complain(f"{name} ended by itself with code {child.returncode}; its own words are above")
    return ENDED


class _Changes:
    """Whether a file is another than it was."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._stamp = self._look()

    def seen(self) -> bool:
        """Since the last time that this was asked."""
        before, self._stamp = self._stamp, self._look()
        return self._stamp != before

    def _look(self) -> tuple[int, int] | None:
        try:
            found = self._path.stat() if self._path else None
        except OSError:
            return None
        return None if found is None else (found.st_mtime_ns, found.st_ino)


def _answers(name: str, child: "subprocess.Popen[bytes]", host: str, ports: Sequence[int]) -> bool:
    """Wait until every port takes a connection, or the server has ended."""
    deadline = time.monotonic() + _START_S
    waiting = list(ports)
    while waiting and child.poll() is None:
        try:
            socket.create_connection((host, waiting[0]), timeout=1.0).close()
            del waiting[0]
        except OSError:
            if time.monotonic() > deadline:
                _complain(f"{name} does not listen on {host}:{waiting[0]}")
                child.terminate()
                return False
            time.sleep(0.02)
    return not waiting


def _complain(text: str) -> None:
    print(f"broker: {text}", file=sys.stderr)  # noqa: T201 (a terminal program prints)


def _die_with_parent() -> None:
    """Let the kernel end the server when this program is killed, so that none is left behind on the port."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
