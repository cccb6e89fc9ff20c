"""A NAO for tests: the process that hosts NAOqi's services, and the program that it starts beside itself."""

import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import Twist
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import ROOT

_SERVICES = Path(__file__).with_name("services.py")
_WATCHDOG = ROOT / "examples" / "nao" / "telescope_watchdog.py"
_SIMULATED = "tests.harness.robots.naoqi.simulated_nao"


class NaoPeer:
    """The robot; it starts at home, standing and stiff.

    Args:
        robot_type: Joints and limits.
        python: Interpreter that has ``qi``.
        simulated: Whether the joints are those of the simulation, instead of a simple model.
        watchdog: Whether the program for the robot is installed.
    """

    def __init__(self, robot_type: RobotType, python: Path, *, simulated: bool = False, watchdog: bool = True) -> None:
        self._names = [joint.name for joint in robot_type.joints]
        self._lock = threading.Lock()
        self._python = python
        program: list[str | Path] = (
            [sys.executable, "-m", _SIMULATED, _packages(python)] if simulated else [python, "-I", _SERVICES]
        )
        self.process = subprocess.Popen(program, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        config = {
            "joints": self._names,
            "speeds": [joint.max_velocity_rad_s for joint in robot_type.joints],
            "home": [robot_type.home_rad[name] for name in self._names],
        }
        self.url: str = self._exchange(config)
        self.watchdog: subprocess.Popen[str] | None = None
        if watchdog:
            self.start_watchdog()

    def start_watchdog(self) -> None:
        """Start the program for the robot, as NAOqi does."""
        self.watchdog = subprocess.Popen(
            [self._python, "-I", _WATCHDOG, self.url], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self.watchdog.stdout is not None
        assert "ready\n" in iter(self.watchdog.stdout.readline, "")  # after lines of the library

    def end_watchdog(self) -> None:
        """End that program."""
        watchdog, self.watchdog = self.watchdog, None
        if watchdog is not None:
            assert watchdog.stdout is not None
            watchdog.kill()
            watchdog.wait()
            watchdog.stdout.close()

    def options(self) -> dict[str, str]:
        """Options of a driver for this robot."""
        return {"address": self.url.removeprefix("tcp://"), "python": str(self._python)}

    def state(self, **request: Any) -> dict[str, Any]:
        """The robot's state, after an optional request."""
        state: dict[str, Any] = self._exchange(request)
        return state

    def joint_positions(self) -> tuple[float, ...]:
        """See ``Peer``."""
        position = self.state()["position"]
        return tuple(position[name] for name in self._names)

    def joint_velocities(self) -> tuple[float, ...]:
        """See ``Peer``."""
        velocity = self.state()["velocity"]
        return tuple(velocity[name] for name in self._names)

    def base_twist(self) -> Twist:
        """See ``Peer``."""
        return Twist(*self.state()["twist"])

    def disturb(self, disturbance: Disturbance) -> None:
        """See ``Peer``."""
        self.state(disturb=disturbance.value)

    def restore(self) -> None:
        """See ``Peer``."""
        self.state(restore=True)
        if self.watchdog is not None and self.watchdog.poll() is not None:  # it has ended with NAOqi
            self.end_watchdog()
            self.start_watchdog()

    def close(self) -> None:
        """Switch the robot off."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.stdout.close()
        self.process.kill()
        self.process.wait()
        self.end_watchdog()

    def _exchange(self, request: Any) -> Any:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with self._lock:
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
            return json.loads(self.process.stdout.readline())


def _packages(python: Path) -> Path:
    """Folder of the packages of a virtual environment, of the same Python version as this one."""
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    return python.parent.parent / "lib" / version / "site-packages"
