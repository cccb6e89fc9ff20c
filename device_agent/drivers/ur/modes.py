"""Robot and safety modes of the controller, as faults. Source: Universal Robots, *RTDE Guide*."""

from device_agent.ports.driver import DriverFault

NORMAL, REDUCED = 1, 2
PROTECTIVE_STOP = 3
RUNNING = 7
"""Robot mode: the arm is powered and its brakes are released."""
POWERED = (5, RUNNING)
"""Robot modes after the arm was switched on, with closed and with released brakes."""
STOPPED, PLAYING, PAUSED = 1, 2, 4
"""Runtime states: no program runs, a program runs, a program is paused."""

_AT_ROBOT = "remove the cause and release it at the robot"
_SAFETY = {
    PROTECTIVE_STOP: ("protective-stop", "protective stop", "remove the cause, then unlock it"),
    4: ("recovery-mode", "recovery mode", "move the joints back into their limits at the robot"),
    5: ("safeguard-stop", "safeguard stop", "close the safeguard and reset it"),
    6: ("emergency-stop", "emergency stop of the system", _AT_ROBOT),
    7: ("emergency-stop", "emergency stop at the robot", _AT_ROBOT),
    8: ("safety-violation", "violation of a safety limit", "restart the safety system at the robot"),
    9: ("safety-fault", "fault of the safety system", "restart the safety system at the robot"),
    10: ("validate-joint", "a joint has to be validated", "validate it at the robot"),
    12: ("safeguard-stop", "safeguard stop in automatic mode", "close the safeguard and reset it"),
    13: ("enabling-stop", "the three-position enabling device is not pressed", "press it, or select automatic mode"),
}
_ROBOT = {
    -1: "the controller is not ready",
    0: "the arm is disconnected",
    1: "the safety configuration has to be confirmed",
    2: "the arm starts",
    3: "the arm is switched off",
    4: "the arm is switched on and not initialized",
    5: "the brakes are not released",
    6: "the arm is in freedrive",
    8: "the arm's firmware is updated",
}


def fault(safety_mode: int, robot_mode: int) -> DriverFault | None:
    """The fault of these modes, or ``None`` if the robot may move. Unknown modes are faults."""
    if safety_mode not in (NORMAL, REDUCED):
        unknown = ("safety-unknown", f"unknown safety mode {safety_mode}", "check the robot's screen")
        code, name, advice = _SAFETY.get(safety_mode, unknown)
        return DriverFault(code, f"{name}; {advice}")
    if robot_mode != RUNNING:
        name = _ROBOT.get(robot_mode, f"unknown robot mode {robot_mode}")
        return DriverFault("not-running", f"{name}; start the arm")
    return None
