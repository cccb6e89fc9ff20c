"""Commands to the dashboard server of the controller. Source: Universal Robots, *Dashboard Server*, port 29999."""

import socket

from device_agent.ports.skills import SkillError

_TIMEOUT_S = 5.0
"""Time to connect, and for each line [s]."""
_MAX_LINE = 1000
_LOCAL = "remote control mode"
"""Part of the response of a controller in local control, which rejects commands from the network."""


class Dashboard:
    """The dashboard server of one controller. Each command opens a connection of its own.

    A controller that was in local control when a client connected rejects the commands of that client for good.

    Args:
        host: Host name or IP address.
        port: Port of the server.
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)

    def execute(self, command: str, *, accepts: str) -> str:
        """Send a command; returns the response. Takes at most some seconds.

        Args:
            command: The command, without its end of line.
            accepts: Start of the response of a controller that executes the command, in lower case.

        Raises:
            SkillError: The controller cannot be reached, is in local control, or rejects the command.
        """
        where = f"{self._address[0]}:{self._address[1]}"
        try:
            with (
                socket.create_connection(self._address, timeout=_TIMEOUT_S) as connection,
                connection.makefile("rb") as lines,
            ):
                lines.readline(_MAX_LINE)  # the greeting
                connection.sendall(command.encode() + b"\n")
                response = lines.readline(_MAX_LINE).decode(errors="replace").strip()
        except OSError as error:
            advice = "enable it in the controller's security settings"
            raise SkillError(f"no response from the dashboard server {where}: {error}; {advice}") from error
        if _LOCAL in response.lower():
            raise SkillError("the robot is in local control; select remote control at the robot, then try again")
        if not response.lower().startswith(accepts):
            raise SkillError(f"the controller rejects '{command}': {response[:300] or 'it closed the connection'}")
        return response
