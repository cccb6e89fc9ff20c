"""Channel to a rosbridge server: JSON messages in WebSocket frames.

The library's own connection would start threads that the agent does not supervise, so its protocol without a
connection is used. Frames to send are built without shared state, so that no thread waits for another one.
"""

import contextlib
import fcntl
import select
import socket
import ssl
import struct
import termios
import time
from collections.abc import Sequence

from websockets.client import ClientProtocol
from websockets.exceptions import WebSocketException
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from device_agent.middleware.ros.tls_socket import TlsSocket
from device_agent.ports.driver import UnreachableError

_TIMEOUT_S = 2.0
"""Time to connect, and for the response [s]."""
_CHECK_S = 0.1
_DELIVERY_S = 0.1
"""Time to deliver the last messages before the socket is closed [s]."""
_DEFAULT_PORT = 9090
_MAX_MESSAGE = 8 << 20
"""A raw picture with 1920 x 1080 pixels has 8.3 MB as Base64 [bytes]."""
_DATA = (Opcode.TEXT, Opcode.BINARY, Opcode.CONT)


class RosbridgeChannel:
    """A connected WebSocket. See ``Channel``.

    Args:
        address: ``host`` or ``host:port``, with ``wss://`` before it for TLS.
        certificate_authority: File with the trusted certificates; empty: those of the system.

    Raises:
        UnreachableError: There is no rosbridge server, or its certificate is not trusted.
    """

    def __init__(self, address: str, *, certificate_authority: str = "") -> None:
        scheme, _, rest = address.rpartition("://")
        host, _, port = rest.partition(":")
        self.where = f"rosbridge at {host}:{port or _DEFAULT_PORT}"
        uri = parse_uri(f"{scheme or 'ws'}://{host}:{port or _DEFAULT_PORT}/")
        self._protocol = ClientProtocol(uri, max_size=_MAX_MESSAGE)
        self._socket: socket.socket | TlsSocket
        context = _trust(certificate_authority) if uri.secure else None
        self._parts: list[bytes] = []
        try:
            connected = socket.create_connection((host, int(port or _DEFAULT_PORT)), timeout=_TIMEOUT_S)
        except (OSError, OverflowError) as error:
            raise UnreachableError(f"no connection to {self.where}: {error}; is rosbridge running?") from error
        try:
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if context is not None:
                connected = context.wrap_socket(connected, server_hostname=host)
            self._shake_hands(connected)
            connected.setblocking(False)
            self._socket = TlsSocket(connected) if isinstance(connected, ssl.SSLSocket) else connected
        except ssl.SSLCertVerificationError as error:
            connected.close()
            raise UnreachableError(
                f"the certificate of {self.where} is not trusted: {error.verify_message}; "
                "check the option 'certificate_authority' and the host name"
            ) from error
        except (OSError, WebSocketException) as error:
            connected.close()
            raise UnreachableError(f"{self.where} is no rosbridge server: {error}; check the port") from error

    def send(self, message: bytes) -> None:
        """See ``Channel``."""
        self._write(Frame(Opcode.TEXT, message).serialize(mask=True))

    def receive(self) -> Sequence[bytes]:
        """See ``Channel``."""
        try:
            if not select.select([self._socket], [], [], _CHECK_S)[0]:
                return self._messages()
            data = self._socket.recv(65536)
        except BlockingIOError:
            return ()
        except ValueError as error:
            raise ConnectionError("the connection was closed") from error
        if not data:
            raise ConnectionError("the server has closed the connection")
        self._protocol.receive_data(data)
        for answer in self._protocol.data_to_send():
            self._write(answer)
        messages = self._messages()
        if self._protocol.state is not State.OPEN and not messages:
            raise ConnectionError("the server has ended the connection, or sent invalid data")
        return messages

    def disconnect(self) -> None:
        """See ``Channel``."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """See ``Channel``. What the other end has not received is discarded.

        Otherwise the kernel would deliver it minutes later, when the network works again, and the robot would move.
        """
        end_s = time.monotonic() + _DELIVERY_S
        while unreceived(self._socket) and time.monotonic() < end_s:
            time.sleep(_DELIVERY_S / 20)
        if unreceived(self._socket):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._socket.close()

    def _shake_hands(self, connected: socket.socket) -> None:
        protocol, end_s = self._protocol, time.monotonic() + _TIMEOUT_S
        protocol.send_request(protocol.connect())
        connected.sendall(b"".join(protocol.data_to_send()))
        while protocol.state is State.CONNECTING:
            data = connected.recv(65536)
            if data:
                protocol.receive_data(data)
            else:
                protocol.receive_eof()
            if protocol.handshake_exc is not None:
                raise protocol.handshake_exc
            if not data or time.monotonic() > end_s:
                raise TimeoutError("no response")

    def _messages(self) -> list[bytes]:
        """Whole messages of the frames that have arrived."""
        messages = []
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode in _DATA:
                self._parts.append(bytes(event.data))
                if event.fin:
                    messages.append(b"".join(self._parts))
                    self._parts = []
        return messages

    def _write(self, data: bytes) -> None:
        """Write without waiting. After a part of a frame nothing else could be written, so the channel is lost."""
        if data and self._socket.send(data, socket.MSG_DONTWAIT) < len(data):
            self.disconnect()
            raise ConnectionError("the other end does not receive; check the network")


def _trust(certificate_authority: str) -> ssl.SSLContext:
    """Settings that verify the server's certificate and host name.

    Raises:
        UnreachableError: The file cannot be read.
    """
    try:
        return ssl.create_default_context(cafile=certificate_authority or None)
    except OSError as error:
        raise UnreachableError(
            f"option 'certificate_authority': {certificate_authority} contains no certificates: {error}"
        ) from error


def unreceived(opened: socket.socket | TlsSocket) -> int:
    """Bytes that the kernel keeps because the other end has not acknowledged them; 0 if it has ended."""
    with contextlib.suppress(OSError):
        return int.from_bytes(fcntl.ioctl(opened, termios.TIOCOUTQ, bytes(4)), "little")
    return 0
