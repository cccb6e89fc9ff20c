"""Notifies systemd (``Type=notify``) of readiness and liveness; does nothing without systemd."""

import contextlib
import os
import socket


def ready(status: str) -> None:
    """Report that startup is complete; ``status`` is shown by ``systemctl status``."""
    _notify(f"READY=1\nSTATUS={status}")


def set_watchdog(timeout_s: float) -> None:
    """Change the time without a notification after which systemd restarts the agent [s]."""
    _notify(f"WATCHDOG_USEC={round(timeout_s * 1e6)}")


def notify_watchdog() -> None:
    """Trigger the watchdog; call more often than ``WatchdogSec``."""
    _notify("WATCHDOG=1")


def _notify(state: str) -> None:
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address or not hasattr(socket, "AF_UNIX"):
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.sendto(state.encode(), address)
