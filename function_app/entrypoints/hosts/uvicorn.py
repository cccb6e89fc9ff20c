"""The HTTP server for one machine: uvicorn."""

import ipaddress
import socket
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import uvicorn
from starlette.middleware import Middleware

import function_app
from function_app.bootstrap import Functions
from function_app.entrypoints.hosts.connection_limits import (
    ACCEPTS_PER_ITERATION,
    ConnectionLimits,
    raise_descriptor_limit,
)
from function_app.entrypoints.hosts.http_connection import HEADERS_S, HttpConnection, RequestLimits
from function_app.entrypoints.hosts.http_host import ALL_ADDRESSES, AllowedHosts
from function_app.entrypoints.hosts.port_taken import PortTaken
from function_app.entrypoints.http import create_app
from function_app.settings import Settings

KEEP_ALIVE_S = 75
"""Longer than the default of 5 s, so that long-polling clients keep their connection."""


_RESERVED_SHARE = 8
"""One in this number of connections is reserved for Stop."""
_TICKS_PER_CHECK = 5
"""Deadlines are checked twice per second."""


def serve(functions: Functions) -> None:
    """Run until SIGINT or SIGTERM.

    Raises:
        PortTaken: The address is in use. The message says how to choose another.
    """
    settings = functions.settings
    limits = _connection_limits(settings)
    listener = limits.listener(listen(settings.host, settings.port))
    app = create_app(functions)
    concurrent = limits.total - limits.total // _RESERVED_SHARE
    # Innermost, so that their responses have the security headers.
    app.user_middleware += [
        Middleware(AllowedHosts, names=allowed_hosts(settings)),
        Middleware(RequestLimits, limits=limits, concurrent=concurrent),
    ]
    protocol: Any = partial(HttpConnection, limits=limits)
    config = uvicorn.Config(
        app,
        loop="asyncio",  # another loop would not accept connections through the listener
        http=protocol,
        ws="none",
        backlog=ACCEPTS_PER_ITERATION,
        timeout_keep_alive=KEEP_ALIVE_S,
        access_log=False,
        log_level="warning",
        log_config=None,  # its lines go to the log of this program
        server_header=False,
        proxy_headers=False,  # TELESCOPE_TRUSTED_PROXIES applies instead
        timeout_graceful_shutdown=3,
        ssl_certfile=None if settings.tls is None else settings.tls.certificate,
        ssl_keyfile=None if settings.tls is None else settings.tls.key,
    )
    function_app.run_for_long()
    _Server(config, limits).run(sockets=[listener])


def allowed_hosts(settings: Settings) -> frozenset[str]:
    """Accepted names in the ``Host`` header: loopback, the address to listen on, the public URL, and the setting.

    A server that listens on all addresses accepts every address, but no unknown name.
    """
    names = {"localhost", "127.0.0.1", "::1", settings.host.lower(), *settings.connections.hosts}
    names.add(urlsplit(settings.public_url).hostname or "")
    return frozenset(names | ({ALL_ADDRESSES} if _listens_everywhere(settings.host) else set()))


def _listens_everywhere(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False


def _connection_limits(settings: Settings) -> ConnectionLimits:
    """The limits; all connections of a reverse proxy have one address, so it limits those of its clients itself."""
    return ConnectionLimits(
        total=max(1, min(settings.connections.total, raise_descriptor_limit())),
        per_address=0 if settings.trusted_proxies else settings.connections.per_address,
        waiting_s=HEADERS_S,
    )


class _Server(uvicorn.Server):
    """uvicorn's server; it also ends connections after their deadlines."""

    def __init__(self, config: uvicorn.Config, limits: ConnectionLimits) -> None:
        super().__init__(config)
        self._limits = limits

    async def on_tick(self, counter: int) -> bool:
        """See ``uvicorn.Server``."""
        if counter % _TICKS_PER_CHECK == 0:
            self._limits.end_late()
        return await super().on_tick(counter)


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
