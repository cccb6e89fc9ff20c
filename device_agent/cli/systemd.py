"""Tells the service manager that the agent runs, where there is one that asks (systemd's ``Type=notify``)."""

import contextlib
import os
import socket


def ready(status: str) -> None:
    """The start is over; ``status`` is for people."""
    _tell(f"READY=1\nSTATUS={status}")


def alive() -> None:
    """To be said more often than the unit's ``WatchdogSec``."""
    _tell("WATCHDOG=1")


def _tell(state: str) -> None:
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address or not hasattr(socket, "AF_UNIX"):
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.sendto(state.encode(), address)
