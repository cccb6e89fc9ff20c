"""``python -m infra.mosquitto``: run mosquitto until SIGTERM or SIGINT.

Prints ``ready tcp=PORT websocket=PORT`` once both listeners answer. Exits 0 when told to stop; 3 when a port is taken
or mosquitto is not installed, 2 when the folder cannot be used; 1 when mosquitto ends by itself. Each with one line.
"""

import argparse
import ctypes
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import FrameType

from infra.mosquitto import configuration

ENDED, BAD_INPUT, CANNOT_START = 1, 2, 3
_START_S = 10.0
_STOP_S = 1.5
_PR_SET_PDEATHSIG = 1


def main() -> int:
    """Run; the exit code."""
    arguments = _arguments()
    home = arguments.home
    try:
        host = _address(arguments.host)
        binary, plugin = configuration.binary(), configuration.plugin()
        tcp_port, websocket_port = _free_ports(host, arguments.tcp_port, arguments.websocket_port)
        configuration.write(home, host=host, tcp_port=tcp_port, websocket_port=websocket_port, plugin_path=plugin)
    except configuration.NotInstalledError as error:
        print(f"broker: {error}", file=sys.stderr)
        return CANNOT_START
    except _PortTakenError as error:
        print(f"broker: {error}; choose another port", file=sys.stderr)
        return CANNOT_START
    except socket.gaierror:
        print(f"broker: '{arguments.host}' has no IPv4 address, which is what it listens on", file=sys.stderr)
        return BAD_INPUT
    except OSError as error:
        print(f"broker: cannot use {error.filename or home}: {error.strerror}", file=sys.stderr)
        return BAD_INPUT
    return _supervise(binary, home, host, tcp_port, websocket_port)


class _PortTakenError(Exception):
    """A port that cannot be listened on."""


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m infra.mosquitto", description="The site's MQTT broker.")
    parser.add_argument("--home", type=Path, required=True, help="folder for its files; made when it is not there")
    parser.add_argument("--host", default="127.0.0.1", help="IPv4 address or name to listen on (default: loopback)")
    parser.add_argument("--tcp-port", type=int, required=True, help="MQTT; 0 takes a free one")
    parser.add_argument("--websocket-port", type=int, required=True, help="MQTT over WebSocket; 0 takes a free one")
    return parser.parse_args()


def _address(host: str) -> str:
    """The IPv4 address of a host: on IPv6 mosquitto's listener for WebSocket cannot be kept to one address.

    Raises:
        socket.gaierror: It has none.
    """
    return str(socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)[0][4][0])


def _free_ports(host: str, *ports: int) -> list[int]:
    """The ports, seen to be free. All are held until the last is known, so that two zeros become two ports.

    Raises:
        _PortTakenError: One is not.
    """
    held: list[socket.socket] = []
    try:
        for port in ports:
            try:
                held.append(socket.socket())
                held[-1].setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                held[-1].bind((host, port))
                held[-1].listen()
            except (OSError, OverflowError) as error:
                why = getattr(error, "strerror", None) or error
                raise _PortTakenError(f"cannot listen on {host}:{port}: {why}") from error
        return [each.getsockname()[1] for each in held]
    finally:
        for each in held:
            each.close()


def _supervise(binary: str, home: Path, host: str, tcp_port: int, websocket_port: int) -> int:
    stopping = False
    child: subprocess.Popen[bytes] | None = None

    def stop(_: int, __: FrameType | None) -> None:
        nonlocal stopping
        stopping = True
        if child is not None:
            child.terminate()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    child = subprocess.Popen(  # noqa: S603 (a path that was looked up, and a file that was written here)
        [binary, "-c", str(home / configuration.CONFIGURATION_FILE)],
        stdin=subprocess.DEVNULL,
        preexec_fn=_die_with_parent,  # noqa: PLW1509 (there is one thread)
        start_new_session=True,  # Ctrl-C reaches this program only, which then ends it in order
    )
    if stopping:
        child.terminate()
    elif _answers(child, host, tcp_port, websocket_port):
        print(f"ready tcp={tcp_port} websocket={websocket_port}", flush=True)
    while child.poll() is None:
        try:
            child.wait(_STOP_S if stopping else None)
        except subprocess.TimeoutExpired:
            child.kill()
    if stopping:
        return 0
    print(f"broker: mosquitto ended by itself with code {child.returncode}; its own words are above", file=sys.stderr)
    return ENDED


def _answers(child: subprocess.Popen[bytes], host: str, *ports: int) -> bool:
    """Wait until every port takes a connection, or the broker has ended."""
    deadline = time.monotonic() + _START_S
    waiting = list(ports)
    while waiting and child.poll() is None:
        try:
            socket.create_connection((host, waiting[0]), timeout=1.0).close()
            del waiting[0]
        except OSError:
            if time.monotonic() > deadline:
                print(f"broker: mosquitto does not listen on {host}:{waiting[0]}", file=sys.stderr)
                child.terminate()
                return False
            time.sleep(0.02)
    return not waiting


def _die_with_parent() -> None:
    """Let the kernel end mosquitto when this program is killed, so that no broker is left behind on the port."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())
