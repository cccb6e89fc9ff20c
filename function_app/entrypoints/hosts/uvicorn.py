"""The HTTP server for one machine: uvicorn."""

import socket

import uvicorn

import function_app
from function_app.bootstrap import Functions
from function_app.entrypoints.http import create_app

KEEP_ALIVE_S = 75
"""Longer than the default of 5 s, so that long-polling clients keep their connection."""


class PortTaken(Exception):  # noqa: N818 (a message for the terminal)
    """Another program uses the address."""


def serve(functions: Functions) -> None:
    """Run until SIGINT or SIGTERM.

    Raises:
        PortTaken: The address is in use. The message says how to choose another.
    """
    listener = listen(functions.settings.host, functions.settings.port)
    tls = functions.settings.tls
    config = uvicorn.Config(
        create_app(functions),
        timeout_keep_alive=KEEP_ALIVE_S,
        access_log=False,
        log_level="warning",
        server_header=False,
        proxy_headers=False,  # TELESCOPE_TRUSTED_PROXIES applies instead
        timeout_graceful_shutdown=3,
        ssl_certfile=None if tls is None else tls.certificate,
        ssl_keyfile=None if tls is None else tls.key,
    )
    function_app.run_for_long()
    uvicorn.Server(config).run(sockets=[listener])


def listen(host: str, port: int) -> socket.socket:
    """A socket bound to the address.

    Raises:
        PortTaken: The address is in use. The message says how to choose another.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sets TCP_NODELAY only if the protocol is explicitly TCP. Without it, each response waits 40 ms for the
    # client's delayed acknowledgement.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise PortTaken(
            f"{host}:{port} cannot be used ({error.strerror}); set TELESCOPE_PORT to a free port"
        ) from error
    return listener
