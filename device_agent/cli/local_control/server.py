"""Server of the control socket: answers status, and gives and takes back the permission to restart."""

import logging
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import msgspec

from device_agent.cli.local_control.messages import (
    SOCKET_FILE,
    TIMEOUT_S,
    ControlRequest,
    ControlResponse,
    SocketAddress,
    receive_line,
)
from device_agent.config.release import VERSION
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.runtime.restart_permission import RestartPermission

_POLL_S = 0.2
_RESPONSE_S = 3 * TIMEOUT_S
_log = logging.getLogger(__name__)


class ControlServer:
    """Serves one connection after the other in its own thread, the only one that uses the permission.

    Args:
        folder: The agent's folder; only its owner and root can connect.
        permission: Decides about a restart.
        linked: Whether the link to the cloud is up.
        restart: Called after a confirmed restart has been answered: ends the agent.
    """

    def __init__(
        self, folder: Path, permission: RestartPermission, *, linked: Callable[[], bool], restart: Callable[[], None]
    ) -> None:
        self._folder = folder
        self._permission = permission
        self._linked = linked
        self._restart = restart
        self._socket: socket.socket | None = None
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name="local-control",
            part="control socket",
            stopping=self._stopping,
            recovery=Recovery.RESTART,
            within_s=_RESPONSE_S,
        )

    def start(self) -> None:
        """Listen. The agent also runs without a control socket; then it cannot be updated while it runs."""
        if not hasattr(socket, "AF_UNIX"):
            return
        (self._folder / SOCKET_FILE).unlink(missing_ok=True)  # left by a killed process
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            with SocketAddress(self._folder) as address:
                listener.bind(address)
            (self._folder / SOCKET_FILE).chmod(0o600)
            listener.listen()
        except OSError as error:
            listener.close()
            _log.warning("no control socket in %s (%s): stop the agent before an update", self._folder, error.strerror)
            return
        listener.settimeout(_POLL_S)
        self._socket = listener
        self._thread.start()

    def stop(self) -> None:
        """Stop to listen. May be called twice."""
        self._stopping.set()
        self._thread.join(_RESPONSE_S)
        if self._socket is not None:
            self._socket.close()
            self._socket = None
            (self._folder / SOCKET_FILE).unlink(missing_ok=True)

    def _run(self) -> None:
        listener = self._socket
        while listener is not None and not self._stopping.is_set():
            self._thread.beat()
            self._permission.expire()
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            with connection:
                connection.settimeout(TIMEOUT_S)
                try:
                    connection.sendall(self._respond(receive_line(connection)))
                except OSError as error:
                    _log.warning("control socket: %s", error)
            if self._permission.confirmed:
                self._restart()

    def _respond(self, line: bytes) -> bytes:
        try:
            response = self._handle(msgspec.json.decode(line, type=ControlRequest))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            response = self._response(ok=False, reason=f"malformed request: {error}"[:300])
        return msgspec.json.encode(response) + b"\n"

    def _handle(self, request: ControlRequest) -> ControlResponse:
        match request.kind:
            case "status":
                return self._response(ok=True)
            case "request-restart":
                token, reason = self._permission.request()
                return self._response(ok=not reason, token=token, reason=reason)
            case "confirm-restart":
                ok = self._permission.confirm(request.token)
            case "cancel-restart":
                ok = self._permission.cancel(request.token)
        return self._response(ok=ok, reason="" if ok else "the permission has expired")

    def _response(self, *, ok: bool, token: str = "", reason: str = "") -> ControlResponse:
        return ControlResponse(ok=ok, version=VERSION, linked=self._linked(), token=token, reason=reason)
