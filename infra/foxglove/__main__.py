"""``python -m infra.foxglove``: show an account's devices live in Foxglove.

Prints ``ready ws://127.0.0.1:PORT`` once the broker is connected. Runs until SIGTERM or SIGINT and reconnects
automatically. The endpoint listens on loopback only, and starts only if the account may view the devices.

The API key is in ``TELESCOPE_KEY``, so that process lists do not show it. Exits with 4 if the key is rejected, or if
the account may not view the devices, also when this right ends while the program runs.
"""

import argparse
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from device_agent.protocol.security import private_folder
from infra import programs, viewer
from infra.viewer import KeyRefusedError, Telescope

if TYPE_CHECKING:
    from foxglove import WebSocketServer

_REFUSED = 4
_RETRY_S = 5.0
_PORT = 8765
"""Foxglove's default port."""
_log = logging.getLogger("infra.foxglove")


class NotPermittedError(OSError):
    """The account may not view the devices."""


def main() -> int:
    """Run the endpoint; returns the exit code."""
    os.umask(private_folder.UMASK)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    arguments = _arguments()
    key = os.environ.get("TELESCOPE_KEY", "").strip()
    if not key.isascii() or not key:
        print("foxglove: TELESCOPE_KEY is empty; create an API key in the console", file=sys.stderr)
        return programs.BAD_INPUT
    try:
        viewer.check_ca(arguments.server, arguments.ca)
    except OSError as error:
        print(f"foxglove: {error}", file=sys.stderr)
        return programs.BAD_INPUT
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    telescope = Telescope(arguments.server, key, arguments.ca)
    try:
        devices = _permitted(telescope, arguments.device)
        return _serve(telescope, devices, arguments.port, stopping)
    except (KeyRefusedError, NotPermittedError) as error:
        print(f"foxglove: {error}", file=sys.stderr)
        return _REFUSED
    except ModuleNotFoundError as error:
        print(
            f"foxglove: {error.name} is not installed; run `pip install 'telescope-server[foxglove]'`", file=sys.stderr
        )
        return programs.CANNOT_START
    except (OSError, ValueError, RuntimeError, programs.PortTakenError) as error:
        print(f"foxglove: {error}", file=sys.stderr)
        return programs.CANNOT_START


def _permitted(telescope: Telescope, requested: list[str]) -> list[str]:
    """Ids of the requested devices, or of all devices that the account may view.

    Raises:
        NotPermittedError: The account may not view a requested device, or any device.
        OSError: The server cannot be reached.
    """
    visible = [str(device["id"]) for device in telescope.devices()]
    missing = [device for device in requested if device not in visible]
    if missing:
        raise NotPermittedError(
            f"this account may not view {', '.join(missing)}; ask the owner to share it with the role viewer"
        )
    if not visible:
        raise NotPermittedError("this account may not view any device; ask an owner to share one with the role viewer")
    return requested or visible


def _serve(telescope: Telescope, devices: list[str], port: int, stopping: threading.Event) -> int:
    """Serve until the program stops or a right ends; returns the exit code."""
    # Imported here: a missing library gets a clear error.
    import foxglove  # noqa: PLC0415

    from infra.foxglove.endpoint import Endpoint  # noqa: PLC0415

    (free_port,) = programs.free_ports((programs.LOOPBACK, port))
    context = foxglove.Context()
    endpoint = Endpoint(context, devices)
    server = foxglove.start_server(name="Telescope", host=programs.LOOPBACK, port=free_port, context=context)
    try:
        while not stopping.is_set():
            try:
                _permitted(telescope, devices)
                _watch(telescope, endpoint.receive, server, stopping)
            except (KeyRefusedError, NotPermittedError):
                raise
            except (OSError, ValueError) as error:
                _log.warning("telescope: %s; reconnecting in %.0f s", error, _RETRY_S)
                stopping.wait(_RETRY_S)
    finally:
        endpoint.close()
        server.stop()
    return 0


def _watch(
    telescope: Telescope, receive: Callable[[str, bytes], None], server: "WebSocketServer", stopping: threading.Event
) -> None:
    ready = partial(print, f"ready ws://{programs.LOOPBACK}:{server.port}", flush=True)
    viewer.watch(telescope, telescope.view_credentials(), receive, stopping, ready)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m infra.foxglove", description="Shows devices live in Foxglove.")
    parser.add_argument("--server", required=True, help="Telescope server, https://host")
    parser.add_argument("--ca", type=Path, metavar="FILE", help="CA certificate (PEM) of the server and its broker")
    parser.add_argument(
        "--device", action="append", default=[], metavar="ID", help="id of a device; may be repeated (default: all)"
    )
    parser.add_argument("--port", type=int, default=_PORT, help="port on loopback, 0: any (default: %(default)d)")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
