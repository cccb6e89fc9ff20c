"""The controller without its network: joints, registers, modes and the running program, in cycles of 8 ms."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from tests.harness.robots.universal_robots import urscript

CYCLE_S = 0.008
JOINTS = 6
MAX_VELOCITY_RAD_S = 3.3
_MAX_ACCELERATION_RAD_S2 = 60.0
_STOP_RAD_S2 = 25.0
"""Deceleration of a protective stop, and of a program that ends during a motion."""
_LAG_S = 0.04
STOPPED, PLAYING, PAUSED = 1, 2, 4
NORMAL, PROTECTIVE_STOP, EMERGENCY_STOP = 1, 3, 7
POWERED_OFF, IDLE, RUNNING = 3, 5, 7
PICK = """\
def pick():
  q = get_target_joint_positions()
  i = 0
  while i < 100:
    q[0] = q[0] + 0.005
    servoj(q)
    i = i + 1
  end
  stopj(10.0)
end
"""
"""A program that turns the first joint by 0.5 rad in 0.8 s."""


class Controller:
    """One controller. Its time advances by ``step`` only, so that measured times do not depend on the machine's load.

    Attributes:
        remote: Whether it takes programs from the network.
        protective_s: When the present protective stop began [s].
        files: Stored programs, by path.
        loaded: Path of the loaded program.
        digital_outputs: Digital outputs as bits: standard from 0, tool from 16; ``digital_inputs`` likewise.
        outputs_follow: Whether outputs follow RTDE; False: a program controls them.
        each_cycle: Called after each cycle.
    """

    def __init__(self, position_rad: Sequence[float]) -> None:
        self.time_s = 0.0
        self.position = list(position_rad)
        self.velocity = [0.0] * JOINTS
        self.integer_inputs = [0] * 48
        self.float_inputs = [0.0] * 48
        self.integer_outputs = [0] * 48
        self.safety_mode = NORMAL
        self.robot_mode = RUNNING
        self.runtime_state = STOPPED
        self.remote = True
        self.protective_s = 0.0
        self.files = {"pick.urp": PICK, "endless.urp": PICK.replace("i < 100", "i < 100000").replace("0.005", "0.001")}
        self.loaded = ""
        self.digital_outputs = 0
        self.digital_inputs = 0b101
        self.outputs_follow = True
        self.each_cycle: Callable[[Controller], None] = lambda _: None
        self.started_programs = 0
        self._program: Iterator[tuple[str, Any]] | None = None
        self._stop_rad_s2 = 0.0

    @property
    def at_rest(self) -> bool:
        """Whether no joint moves."""
        return all(abs(value) < 1e-3 for value in self.velocity)

    def run(self, text: str) -> None:
        """Replace the program by a new one. Without remote control, or while the arm is stopped, it is ignored."""
        if not self.remote or self.safety_mode != NORMAL or self.robot_mode != RUNNING:
            return
        functions: dict[str, Callable[..., Any]] = {
            "get_steptime": lambda: CYCLE_S,
            "get_target_joint_positions": lambda: list(self.position),
            "read_input_integer_register": self.integer_inputs.__getitem__,
            "read_input_float_register": self.float_inputs.__getitem__,
            "write_output_integer_register": self.integer_outputs.__setitem__,
            "servoj": lambda q, *_: ("servoj", list(q)),
            "stopj": lambda a: ("stopj", a),
            "sync": lambda: ("sync", None),
        }
        with contextlib.suppress(urscript.ScriptError):
            self._program = urscript.load(text, functions)
            self._stop_rad_s2 = 0.0
            self.runtime_state = PLAYING
            self.started_programs += 1

    def end_program(self) -> None:
        """End the program, as the button at the pendant does."""
        self._program, self.runtime_state = None, STOPPED

    def pause_program(self) -> None:
        """Pause the program, as the button at the pendant does."""
        self.runtime_state = PAUSED

    def continue_program(self) -> None:
        """Continue a paused program."""
        self.runtime_state = PLAYING

    def set_safety_mode(self, mode: int) -> None:
        """Change the safety mode. A protective stop pauses the program, other stops end it."""
        self.safety_mode = mode
        self.protective_s = self.time_s
        if mode == PROTECTIVE_STOP and self._program is not None:
            self.runtime_state = PAUSED
        elif mode != NORMAL:
            self.end_program()

    def step(self) -> None:
        """One cycle."""
        self.time_s += CYCLE_S
        call, argument = self._call()
        if call == "servoj":
            for joint, target in enumerate(argument):
                wanted = min(max((target - self.position[joint]) / _LAG_S, -MAX_VELOCITY_RAD_S), MAX_VELOCITY_RAD_S)
                self._accelerate(joint, wanted, _MAX_ACCELERATION_RAD_S2)
        elif call != "sync":  # the worst case: a program that only waits does not end a motion
            for joint in range(JOINTS):
                self._accelerate(joint, 0.0, argument or _STOP_RAD_S2)
        for joint in range(JOINTS):
            self.position[joint] += self.velocity[joint] * CYCLE_S
        self.each_cycle(self)

    def _call(self) -> tuple[str, Any]:
        """What the program calls in this cycle. ``stopj`` lasts until the arm is at rest."""
        if self._program is None or self.runtime_state != PLAYING:
            return "", None
        if self._stop_rad_s2 and not self.at_rest:
            return "stopj", self._stop_rad_s2
        self._stop_rad_s2 = 0.0
        try:
            call, argument = next(self._program)
        except StopIteration:
            self.end_program()
            return "", None
        if call == "stopj":
            self._stop_rad_s2 = argument
        return call, argument

    def _accelerate(self, joint: int, wanted: float, limit_rad_s2: float) -> None:
        change = limit_rad_s2 * CYCLE_S
        self.velocity[joint] += min(max(wanted - self.velocity[joint], -change), change)
