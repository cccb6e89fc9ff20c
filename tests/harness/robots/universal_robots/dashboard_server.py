"""Dashboard server of the emulated controller, from the manufacturer's page; independent of the driver's code."""

from tests.harness.robots.universal_robots.controller import (
    IDLE,
    NORMAL,
    POWERED_OFF,
    PROTECTIVE_STOP,
    RUNNING,
    STOPPED,
    Controller,
)

GREETING = "Connected: Universal Robots Dashboard Server\n"
NOT_REMOTE = (
    "Command is not allowed due to safety reasons, "
    "please switch robot to Remote Control mode and reconnect to port 29999"
)
_UNLOCK_S = 5.0


class DashboardSession:
    """One client: it keeps the rights that it had when it connected.

    Args:
        controller: The controller.
        executed: Receives each command.
    """

    def __init__(self, controller: Controller, executed: list[str]) -> None:
        self._controller = controller
        self._executed = executed
        self._remote = controller.remote
        self._buffer = ""

    def receive(self, data: bytes) -> bytes:
        """Process received bytes. Returns the responses."""
        *lines, self._buffer = (self._buffer + data.decode()).split("\n")
        return "".join(self._respond(line.strip()) + "\n" for line in lines).encode()

    def _respond(self, command: str) -> str:
        self._executed.append(command)
        if not self._remote:
            return NOT_REMOTE
        name, _, argument = command.partition(" ") if command.startswith("load ") else (command, "", "")
        commands = {
            "stop": self._stop,
            "unlock protective stop": self._unlock,
            "close safety popup": lambda: "closing safety popup",
            "power on": self._power_on,
            "brake release": self._release_brakes,
            "load": lambda: self._load(argument),
            "play": self._play,
        }
        return commands.get(name, lambda: f"could not understand: '{command}'")()

    def _stop(self) -> str:
        self._controller.end_program()
        return "Stopped"

    def _power_on(self) -> str:
        if self._controller.robot_mode == POWERED_OFF:
            self._controller.robot_mode = IDLE
        return "Powering on"

    def _release_brakes(self) -> str:
        self._controller.robot_mode = RUNNING
        return "Brake releasing"

    def _unlock(self) -> str:
        controller = self._controller
        if controller.safety_mode == PROTECTIVE_STOP and controller.time_s - controller.protective_s < _UNLOCK_S:
            return (
                "Cannot unlock protective stop until 5s after occurrence. "
                "Always inspect cause of protective stop before unlocking"
            )
        controller.set_safety_mode(NORMAL)
        return "Protective stop releasing"

    def _load(self, path: str) -> str:
        controller = self._controller
        if path not in controller.files or controller.runtime_state != STOPPED:
            return f"File not found: {path}"
        controller.loaded = path
        return f"Loading program: {path}"

    def _play(self) -> str:
        controller = self._controller
        if not controller.loaded or controller.safety_mode != NORMAL or controller.robot_mode != RUNNING:
            return "Failed to execute: play"
        controller.run(controller.files[controller.loaded])
        return "Starting program"
