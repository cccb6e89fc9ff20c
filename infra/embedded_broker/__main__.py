"""``python -m infra.embedded_broker``: run the embedded broker until SIGTERM or SIGINT.

Prints ``ready tcp=PORT websocket=PORT`` once it listens. Exit codes: 0 on a signal, 3 if a port is in use, 2 for an
invalid file or argument; errors print one line with advice.
"""

import argparse
import asyncio
import gc
import logging
import os
import signal
import socket
import ssl
import sys
from pathlib import Path
from typing import Any

import function_app
from device_agent.protocol.security import private_folder
from function_app.entrypoints.hosts.connection_limits import raise_descriptor_limit
from infra.embedded_broker.broker import TCP, WEBSOCKET, TelescopeBroker
from infra.embedded_broker.limits import Limits
from infra.embedded_broker.log_filter import RepeatFilter
from infra.embedded_broker.public_keys import KeyRing, KeysError
from infra.embedded_broker.revocations import Revocations, RevocationsError

FULL_COLLECTION = (1, 1)
"""Thresholds of older generations. A message leaves no garbage, but a connection does; with Python's own (10, 10), that
of 5,000 connections remained, 3 MB."""

log = logging.getLogger("telescope.broker")

BAD_INPUT, PORT_TAKEN = 2, 3


def main() -> int:
    """Run the broker; returns the exit code."""
    os.umask(private_folder.UMASK)
    arguments = _arguments()
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    log.addFilter(RepeatFilter())
    revocations_path: Path = arguments.revocations or arguments.keys.with_name(f"{arguments.keys.name}.revoked")
    limits = Limits().within(raise_descriptor_limit())
    keys = KeyRing(arguments.keys)
    revocations = Revocations(revocations_path, lifetime_s=limits.lifetime_s)
    try:
        keys.refresh()
        revocations.open()
    except (KeysError, RevocationsError) as error:
        print(f"broker: {error}", file=sys.stderr)
        return BAD_INPUT
    try:
        tls = _tls(arguments)
    except OSError as error:  # SSLError is one
        print(f"broker: cannot use {arguments.certificate} with {arguments.certificate_key}: {error}", file=sys.stderr)
        return BAD_INPUT
    sockets: dict[str, socket.socket] = {}
    for name, port in ((TCP, arguments.tcp_port), (WEBSOCKET, arguments.websocket_port)):
        try:
            sockets[name] = _bind(arguments.host, port)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            print(f"broker: cannot listen on {arguments.host}:{port}: {reason}; choose another port", file=sys.stderr)
            return PORT_TAKEN
    asyncio.run(_run(sockets, keys, revocations, limits, tls))
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m infra.embedded_broker", description="The embedded MQTT broker.")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: loopback only)")
    parser.add_argument("--tcp-port", type=int, required=True, help="MQTT; 0 selects a free port")
    parser.add_argument("--websocket-port", type=int, required=True, help="MQTT over WebSocket; 0 selects a free port")
    parser.add_argument(
        "--keys", type=Path, required=True, help='JSON {"key id": "Ed25519 public key in base64url"}, read on change'
    )
    parser.add_argument("--certificate", type=Path, help="use TLS only, with this certificate and its chain (PEM)")
    parser.add_argument("--certificate-key", type=Path, help="its key (PEM)")
    parser.add_argument("--revocations", type=Path, help="file for revoked tokens (default: next to the keys)")
    arguments = parser.parse_args()
    if bool(arguments.certificate) != bool(arguments.certificate_key):
        parser.error("--certificate and --certificate-key must be given together")
    return arguments


def _tls(arguments: argparse.Namespace) -> ssl.SSLContext | None:
    """The TLS context of the listeners; ``None`` without TLS.

    Raises:
        OSError: A file cannot be read or is invalid.
    """
    if arguments.certificate is None:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_cert_chain(arguments.certificate, arguments.certificate_key)
    return context


def _bind(host: str, port: int) -> socket.socket:
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    bound = socket.socket(family, kind, protocol)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen(128)
    except BaseException:
        bound.close()
        raise
    bound.setblocking(False)
    return bound


async def _run(
    sockets: dict[str, socket.socket],
    keys: KeyRing,
    revocations: Revocations,
    limits: Limits,
    tls: ssl.SSLContext | None,
) -> None:
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(_log_exception)
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    broker = TelescopeBroker(sockets=sockets, keys=keys, revocations=revocations, limits=limits, tls=tls)
    ports = {name: bound.getsockname()[1] for name, bound in sockets.items()}
    await broker.start()
    function_app.run_for_long()
    gc.set_threshold(gc.get_threshold()[0], *FULL_COLLECTION)
    print(f"ready tcp={ports[TCP]} websocket={ports[WEBSOCKET]}", flush=True)
    await stop.wait()
    await broker.shutdown()


def _log_exception(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    error = context.get("exception")
    log.error("%s%s", context.get("message", "error"), f": {type(error).__name__}: {error}" if error else "")


if __name__ == "__main__":
    sys.exit(main())
