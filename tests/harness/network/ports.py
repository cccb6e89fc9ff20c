"""TCP ports for servers that tests start or restart later."""

import contextlib
import fcntl
import os
import socket
import tempfile
from pathlib import Path

HOST = "127.0.0.1"
_RANGE = range(12_000, 32_000)
"""Below the ports that Linux assigns itself (32768 to 60999): a released port is not assigned to another program."""
_STRIDE = 997
_COUNTER = Path(tempfile.gettempdir()) / f"telescope-test-ports-{os.getuid()}"


def free_port(count: int = 1) -> int:
    """The first of consecutive free ports on loopback. Test processes that run at the same time get different ports.

    A port from ``bind(0)`` may be assigned to another test between its release and its use. The first call on a machine
    begins at a place that depends on the process: a container has its own counter, but may share the machine's ports.
    """
    with _COUNTER.open("a+") as counter:
        fcntl.flock(counter, fcntl.LOCK_EX)
        counter.seek(0)
        offset = int(counter.read() or os.getpid() * _STRIDE % len(_RANGE))
        for _ in range(len(_RANGE) // count):
            if offset + count > len(_RANGE):
                offset = 0
            first = _RANGE[offset]
            offset += count
            if _all_free(range(first, first + count)):
                counter.truncate(0)
                counter.write(str(offset))
                return first
    raise OSError(f"no {count} consecutive free ports")


def _all_free(ports: range) -> bool:
    with contextlib.ExitStack() as stack:
        try:
            for port in ports:
                stack.enter_context(socket.socket()).bind((HOST, port))
        except OSError:
            return False
    return True
