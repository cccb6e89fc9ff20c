"""Limits for accepted TCP connections of one process: in total, for each address, and in time.

The listening socket applies them when it accepts. They therefore work under every protocol and also count connections
whose TLS handshake is incomplete. A new connection replaces the oldest one that does no work, so that clients which
send nothing cannot keep others out.
"""

import contextlib
import errno
import ipaddress
import math
import resource
import socket
import time
from asyncio import BaseTransport, Transport
from collections import OrderedDict
from collections.abc import Callable
from enum import IntEnum
from typing import Any, cast

ACCEPTS_PER_ITERATION = 8
"""Connections that the event loop accepts before it processes received data; the ``backlog`` of asyncio servers."""
_QUEUE = 4_096
"""Connections that the kernel holds until they are accepted."""
_CLOSING = 8 * ACCEPTS_PER_ITERATION
"""Closed connections whose descriptors the event loop has not released yet."""
_RESERVED_DESCRIPTORS = 128 + _CLOSING
"""Descriptors for files, tables, the broker and closing connections."""
_MAX_DESCRIPTORS = 65_536
_MAX_TRUSTED = 10_000
_IPV6_NETWORK = 64
_NO_DESCRIPTOR = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


class State(IntEnum):
    """What a connection does; lower values are closed first."""

    WAITING = 0
    """The request, or the authentication, is incomplete."""
    IDLE = 1
    """Between two requests."""
    ACTIVE = 2
    """A request is being processed. Never closed for another connection."""


class AcceptedSocket(socket.socket):
    """The socket of one connection."""

    limits: "ConnectionLimits"
    address: str
    state: State
    deadline_s: float
    transport: Transport | None = None
    trusted: bool = False

    def close(self) -> None:
        """Close the socket, and count it no more."""
        self.limits.remove(self)
        self.transport = None  # otherwise both remain until the next garbage collection
        super().close()

    def end(self) -> None:
        """End the connection; the event loop then closes the socket."""
        if self.transport is not None:
            self.transport.abort()
        else:
            with contextlib.suppress(OSError):
                self.shutdown(socket.SHUT_RDWR)


class _Listener(socket.socket):
    """A listening socket that accepts connections within limits."""

    limits: "ConnectionLimits"

    def listen(self, backlog: int = 0, /) -> None:
        """Listen with a long queue: asyncio's backlog is only the number of connections accepted at once."""
        super().listen(max(backlog, _QUEUE))

    def accept(self) -> tuple[socket.socket, Any]:
        """See ``socket.accept``.

        Raises:
            BlockingIOError: No connection, or no descriptor is free at the moment.
        """
        for _ in range(ACCEPTS_PER_ITERATION):
            self.limits.require_descriptor()
            try:
                plain, address = super().accept()
            except OSError as error:
                if error.errno not in _NO_DESCRIPTOR:
                    raise
                self.limits.end_oldest()
                raise BlockingIOError from error
            accepted = AcceptedSocket(self.family, self.type, self.proto, plain.detach())
            if self.limits.admit(accepted, address[0]):
                return accepted, address
            accepted.close()
        raise BlockingIOError


class ConnectionLimits:
    """Connections of one process, and which of them make room for new ones.

    Args:
        total: Connections in total. A new one replaces the oldest waiting one, or else the oldest idle one.
        per_address: Connections of one address; a new one replaces one of the same address. 0: no limit.
        waiting_s: Time in which a connection must leave the state ``WAITING`` [s].
        now_s: Monotonic clock [s].

    Attributes:
        active: Connections in the state ``ACTIVE``.
        ended: Connections that were ended for a limit.
    """

    def __init__(
        self, *, total: int, per_address: int, waiting_s: float, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.total = total
        self.active = 0
        self.ended = 0
        self._per_address = per_address
        self._waiting_s = waiting_s
        self.now_s = now_s
        self._sockets: dict[int, AcceptedSocket] = {}
        self._limited: dict[str, OrderedDict[AcceptedSocket, None]] = {}
        self._count = 0
        self._replaceable: dict[tuple[bool, State], OrderedDict[AcceptedSocket, None]] = {
            (trusted, state): OrderedDict() for trusted in (False, True) for state in (State.WAITING, State.IDLE)
        }
        self._trusted: OrderedDict[str, None] = OrderedDict()

    @property
    def open(self) -> int:
        """Number of sockets that are not closed."""
        return len(self._sockets)

    def listener(self, bound: socket.socket) -> socket.socket:
        """A socket to listen on in place of ``bound``, which it takes over."""
        family, kind, protocol = bound.family, bound.type, bound.proto
        listener = _Listener(family, kind, protocol, bound.detach())
        listener.limits = self
        return listener

    def attach(self, transport: BaseTransport) -> AcceptedSocket | None:
        """The connection of a transport; ``None`` if it was not accepted here."""
        connection = self._sockets.get(transport.get_extra_info("socket").fileno())
        if connection is not None:
            connection.transport = cast("Transport", transport)
        return connection

    def mark(self, connection: AcceptedSocket, state: State, deadline_s: float = math.inf) -> None:
        """Set the state of a connection and the monotonic time at which it ends [s]."""
        if not connection.address:
            return  # ended or released
        connection.deadline_s = deadline_s
        if state is not connection.state:
            self._leave(connection)
            self._enter(connection, state)

    def release(self, connection: AcceptedSocket) -> None:
        """Apply limits and deadlines to this connection no longer."""
        self._forget(connection)
        connection.deadline_s = math.inf

    def trust(self, address: str) -> None:
        """Close connections of this address last: a client authenticated from it."""
        address = _network(address)
        self._trusted[address] = None
        self._trusted.move_to_end(address)
        if len(self._trusted) > _MAX_TRUSTED:
            self._trusted.popitem(last=False)

    def end_late(self) -> None:
        """End connections whose deadline has passed."""
        now_s = self.now_s()
        for connection in list(self._sockets.values()):
            if now_s >= connection.deadline_s:
                self._end(connection)

    def end_oldest(self) -> bool:
        """End the oldest replaceable connection; returns False if there is none."""
        for connections in self._replaceable.values():
            if connections:
                self._end(next(iter(connections)))
                return True
        return False

    # ------------------------------------------------------------ for sockets

    def require_descriptor(self) -> None:
        """Raise ``BlockingIOError`` while too many ended connections wait to be closed."""
        if len(self._sockets) - self._count >= _CLOSING and self._count >= self.total:
            raise BlockingIOError

    def admit(self, connection: AcceptedSocket, address: str) -> bool:
        """Count a new connection; ends another one if necessary. Returns False if all are active."""
        connection.limits = self
        connection.address = _network(address)
        connection.state = State.WAITING
        connection.deadline_s = self.now_s() + self._waiting_s
        connection.trusted = connection.address in self._trusted
        self._sockets[connection.fileno()] = connection
        if not self._make_room(connection.address):
            connection.address = ""
            return False
        self._limited.setdefault(connection.address, OrderedDict())[connection] = None
        self._count += 1
        self._enter(connection, State.WAITING)
        return True

    def remove(self, connection: AcceptedSocket) -> None:
        """Count a closed connection no more."""
        self._forget(connection)
        if self._sockets.get(connection.fileno()) is connection:
            del self._sockets[connection.fileno()]

    # ------------------------------------------------------------ internals

    def _make_room(self, address: str) -> bool:
        own = self._limited.get(address, OrderedDict())
        if self._per_address and len(own) >= self._per_address:
            replaceable = [connection for connection in own if connection.state is not State.ACTIVE]
            if not replaceable:
                return False
            self._end(min(replaceable, key=lambda connection: connection.state))
            return True
        return self._count < self.total or self.end_oldest()

    def _end(self, connection: AcceptedSocket) -> None:
        self._forget(connection)
        self.ended += 1
        connection.deadline_s = self.now_s() + 1  # again, if the transport did not notice
        connection.end()

    def _forget(self, connection: AcceptedSocket) -> None:
        if not connection.address:
            return
        self._leave(connection)
        self._count -= 1
        own = self._limited[connection.address]
        del own[connection]
        if not own:
            del self._limited[connection.address]
        connection.address = ""

    def _enter(self, connection: AcceptedSocket, state: State) -> None:
        connection.state = state
        if state is State.ACTIVE:
            self.active += 1
        else:
            self._replaceable[connection.trusted, state][connection] = None

    def _leave(self, connection: AcceptedSocket) -> None:
        if connection.state is State.ACTIVE:
            self.active -= 1
        else:
            del self._replaceable[connection.trusted, connection.state][connection]


def raise_descriptor_limit() -> int:
    """Raise the limit of open files as far as permitted; returns how many connections it allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _MAX_DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(ValueError, OSError):  # macOS has a lower limit than it states
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            soft = wanted
    return (_MAX_DESCRIPTORS if soft == resource.RLIM_INFINITY else soft) - _RESERVED_DESCRIPTORS


def _network(address: str) -> str:
    """The address, or the network of an IPv6 address: one client controls all its 2⁶⁴ addresses."""
    if ":" not in address:
        return address
    parsed = ipaddress.ip_address(address.partition("%")[0])
    if isinstance(parsed, ipaddress.IPv6Address) and parsed.ipv4_mapped is None:
        return str(ipaddress.ip_network((parsed, _IPV6_NETWORK), strict=False))
    return str(getattr(parsed, "ipv4_mapped", parsed))
