"""Client of the control socket."""

import socket
from pathlib import Path

import msgspec

from device_agent.cli.local_control.messages import (
    TIMEOUT_S,
    ControlRequest,
    ControlResponse,
    SocketAddress,
    receive_line,
)
from device_agent.config.errors import ConfigError


def call(folder: Path, request: ControlRequest) -> ControlResponse | None:
    """Send a request to the agent that runs this folder; ``None`` if no agent listens.

    Raises:
        ConfigError: An agent listens, but it does not respond, or this user may not connect.
    """
    if not hasattr(socket, "AF_UNIX"):
        return None
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(TIMEOUT_S)
        try:
            with SocketAddress(folder) as address:
                connection.connect(address)
            connection.sendall(msgspec.json.encode(request) + b"\n")
            line = receive_line(connection)
            return msgspec.json.decode(line, type=ControlResponse)
        except (FileNotFoundError, ConnectionRefusedError):
            return None
        except PermissionError as error:
            raise ConfigError(f"{folder} belongs to another user; run this command as that user or as root") from error
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ConfigError(
                f"the agent of {folder} runs but does not respond ({error or 'time is over'}); stop its service first"
            ) from error
