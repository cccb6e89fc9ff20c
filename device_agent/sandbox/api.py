"""Names that a script can use: ``robot``, ``room``, ``parameters``, ``wait``, ``progress``, ``print``, ``RobotError``.

Each call of ``robot`` blocks until it is complete. It raises ``RobotError`` with the reason if it fails: the robot
lacks the ability, a limit prevents it, or an operator stopped it. Units are SI and radians.

The script process has no files, network or other processes. It may import the modules of ``importable_modules``.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

Request = Callable[..., Any]
"""``request(kind, **arguments)``: sends a call to the agent and returns its response."""
Send = Callable[..., None]
"""``send(kind, **arguments)``: sends a message without response."""

OLD_S = 5.0
"""Older occupancy measurements are ignored [s]."""

_SKILLS = ("posture", "behaviour", "express", "say", "drive", "go_to", "set_control")
"""Skills that a keyframe may contain."""


class RobotError(Exception):
    """The robot did not execute a call; the message names the reason. Ends the script unless caught."""


class Robot:
    """``robot``: the device that the script runs on.

    Attributes:
        joints: Names of its joints, in the order of lists of positions.
        frames: Names of the frames that ``move_to`` can move.
        can: Names of the calls that this robot supports; others raise ``RobotError``.
    """

    def __init__(self, request: Request, *, joints: Sequence[str], frames: Sequence[str], can: Sequence[str]) -> None:
        self._request = request
        self.joints = tuple(joints)
        self.frames = tuple(frames)
        self.can = tuple(can)

    def move_joints(
        self, position_rad: Mapping[str, float] | Sequence[float], speed: float = 0.5, *, plan: bool = False
    ) -> None:
        """Move joints and wait until they arrive.

        Args:
            position_rad: Joint name → position [rad] (others keep theirs), or a list in the order of ``robot.joints``.
            speed: Share of each joint's velocity limit, above 0, up to 1.
            plan: Plan a path around obstacles.
        """
        self._request("move_joints", position_rad=self._by_name(position_rad), speed=float(speed), plan=bool(plan))

    def play(self, keyframes: Sequence[Mapping[str, Any]], speed: float = 1.0) -> None:
        """Play keyframes at their times; joints pass through keyframes smoothly and rest where they reverse.

        Moves to the first keyframe at half speed, and counts time from there. Keyframes that the limits do not allow in
        time are delayed, with all later ones.

        Args:
            keyframes: Dictionaries in the order of ``time_s``. ``position_rad``: joint name → position [rad]; unnamed
                joints move on to their next named position. Skills to execute at the keyframe, in this order:
                ``posture``, ``behaviour``, ``express``, ``say``: a name or text; ``drive``, ``go_to``,
                ``set_control``: their arguments by name. Time pauses during skills.
            speed: 1: times as given; 0.5: twice as long. Above 0, up to 2.
        """
        start_s, group = 0.0, []
        for number, keyframe in enumerate(keyframes):
            positions = self._by_name(keyframe.get("position_rad", {}))
            at_s = float(keyframe["time_s"])
            if not math.isfinite(at_s):
                raise RobotError(f"the time of keyframe {number + 1} is not a finite number of seconds")
            if number == 0:
                start_s = at_s
                if positions:
                    self.move_joints(positions, speed=min(0.5, 0.5 * float(speed)))
            else:
                group.append({"time_s": at_s - start_s, "position_rad": positions})
            skills = [name for name in _SKILLS if name in keyframe]
            if group and (skills or number == len(keyframes) - 1):
                first = number + 2 - len(group)
                self._request("play", keyframes=group, first=first, speed=float(speed))
                start_s, group = at_s, []
            for name in skills:
                value = keyframe[name]
                getattr(self, name)(**value) if isinstance(value, Mapping) else getattr(self, name)(value)

    def move_to(
        self,
        position_m: Sequence[float],
        *,
        quaternion: Sequence[float] | None = None,
        rpy_rad: Sequence[float] | None = None,
        frame: str = "",
        speed: float = 0.5,
        straight: bool = False,
        plan: bool = False,
    ) -> None:
        """Move a frame of the robot to a pose, and wait until it arrives.

        Args:
            position_m: x, y, z in the robot's base frame [m].
            quaternion: Orientation (w, x, y, z), or
            rpy_rad: roll, pitch, yaw about the base's x, y, z [rad]. Without either, the orientation is kept.
            frame: One of ``robot.frames``; by default the last one, an arm's flange.
            speed: Share of each joint's velocity limit, above 0, up to 1.
            straight: Move on a straight line.
            plan: Plan a path around obstacles.
        """
        if quaternion is not None and rpy_rad is not None:
            raise RobotError("give a quaternion or rpy_rad, not both")
        self._request(
            "move_pose",
            frame=frame or (self.frames[-1] if self.frames else ""),
            position_m=_numbers(position_m, 3, "position_m"),
            quaternion=None if quaternion is None else _numbers(quaternion, 4, "quaternion"),
            rpy_rad=None if rpy_rad is None else _numbers(rpy_rad, 3, "rpy_rad"),
            speed=float(speed),
            straight=bool(straight),
            plan=bool(plan),
        )

    def home(self, speed: float = 0.5) -> None:
        """Move to the home position of the robot type and wait until it arrives."""
        self._request("home", speed=float(speed))

    def drive(
        self, forward_m_s: float = 0.0, left_m_s: float = 0.0, turn_rad_s: float = 0.0, *, duration_s: float = 1.0
    ) -> None:
        """Drive the base at a velocity for a time, then stop. ``turn_rad_s`` is counter-clockwise."""
        self._request(
            "drive",
            forward_m_s=float(forward_m_s),
            left_m_s=float(left_m_s),
            turn_rad_s=float(turn_rad_s),
            duration_s=float(duration_s),
        )

    def go_to(self, x_m: float, y_m: float, yaw_rad: float | None = None) -> None:
        """Navigate to a position in the room around obstacles, and wait until it arrives.

        Args:
            x_m: x in the room's frame [m].
            y_m: y in the room's frame [m].
            yaw_rad: Final heading, counter-clockwise from the room's x axis; any heading by default.
        """
        self._request("go_to", x_m=float(x_m), y_m=float(y_m), yaw_rad=None if yaw_rad is None else float(yaw_rad))

    def look(self, position_m: Sequence[float], speed: float = 0.5) -> None:
        """Turn the gaze to a point x, y, z in the robot's base frame [m]."""
        self._request("look_at", position_m=_numbers(position_m, 3, "position_m"), speed=float(speed))

    def say(self, text: str, language: str = "") -> None:
        """Speak and wait for the end; ``language``: ``en``, ``sk`` …, or the robot's default."""
        self._request("say", text=str(text), language=str(language))

    def stiffness(self, value: float, joints: Sequence[str] = ()) -> None:
        """Set the holding strength of joints, 0 (limp) to 1; all joints if none is named."""
        self._request("set_stiffness", value=float(value), joints=[str(name) for name in joints])

    def express(self, name: str, strength: float = 1.0) -> None:
        """Show an expression, ``strength`` 0 to 1."""
        self._request("express", name=str(name), strength=float(strength))

    def posture(self, name: str, speed: float = 0.5) -> None:
        """Move to a posture of the robot type and wait until it arrives; ``speed`` as for ``move_joints``."""
        self._request("take_posture", name=str(name), speed=float(speed))

    def behaviour(self, name: str) -> None:
        """Run a behaviour of the robot, and wait for its end."""
        self._request("run_behaviour", name=str(name))

    def set_control(self, name: str, value: float) -> float:
        """Set a control of the robot, such as ``gripper``, and wait; returns the value that the robot has measured.

        A gripper returns a smaller value than the commanded one if its fingers have stopped at an object.

        Args:
            name: Name of the control, as on the robot's page.
            value: Value within the limits of the control.
        """
        return float(self._request("set_control", control=str(name), value=float(value)))

    def state(self) -> dict[str, Any]:
        """Measured ``position_rad``, ``velocity_rad_s``, ``effort_nm`` by joint name, ``frames`` by name, ``mode``.

        A frame is x, y, z [m] and quaternion w, x, y, z in the robot's base frame. ``streams`` contains the other
        measurements by stream: ``values`` by name and their age, ``age_s`` [s].
        """
        state: dict[str, Any] = self._request("state")
        return state

    def _by_name(self, position_rad: Mapping[str, float] | Sequence[float]) -> dict[str, float]:
        if isinstance(position_rad, Mapping):
            return {str(name): float(value) for name, value in position_rad.items()}
        if len(position_rad) != len(self.joints):
            raise RobotError(f"{len(position_rad)} positions for {len(self.joints)} joints: {', '.join(self.joints)}")
        return {name: float(value) for name, value in zip(self.joints, position_rad, strict=True)}

    def __getattr__(self, name: str) -> Any:
        known = sorted(key for key in type(self).__dict__ if not key.startswith("_"))
        raise AttributeError(f"there is no robot.{name}; there are {', '.join(known)}, joints, frames, can")


class Room:
    """``room``: newest measurements of other devices of the space."""

    def __init__(self, request: Request) -> None:
        self._request = request

    def latest(self, device: str, stream: str) -> dict[str, Any] | None:
        """The newest measurement of a stream: ``values`` by name and ``age_s``, time since it arrived [s].

        ``None`` if none has arrived. Check ``age_s`` before using the values.
        """
        measurement: dict[str, Any] | None = self._request("latest", device=str(device), stream=str(stream))
        return measurement

    def taken(self, x_m: float, y_m: float, device: str = "perception") -> bool | None:
        """Whether an obstacle is at a position in the room, in cells of about 0.2 m.

        The calling robot counts as an obstacle too. ``None`` if unknown: not observed, outside of the room, or no
        measurement for ``OLD_S``.

        Raises:
            RobotError: A number is not finite.
        """
        if not (math.isfinite(x_m) and math.isfinite(y_m)):
            raise RobotError(f"a position in the room consists of two finite numbers, not {x_m}, {y_m}")
        occupancy = self.latest(device, "occupancy")
        if occupancy is None or occupancy["age_s"] > OLD_S:
            return None
        floor = occupancy["values"]
        column = math.floor((x_m - floor["lower_x_m"]) / floor["side_m"])
        row = math.floor((y_m - floor["lower_y_m"]) / floor["side_m"])
        if not (0 <= column < floor["columns"] and 0 <= row < floor["rows"]):
            return None
        if int(floor[f"taken_bits.{row}"]) >> column & 1:
            return True
        return None if int(floor[f"unknown_bits.{row}"]) >> column & 1 else False


def namespace(send: Send, request: Request, flush: Callable[[], None], task: Mapping[str, Any]) -> dict[str, Any]:
    """The names that a script can use."""

    def wait(duration_s: float) -> None:
        """Wait [s]; the robot holds."""
        flush()
        if "wait" in task["can"]:  # simulated time
            request("wait", duration_s=float(duration_s))
        else:
            time.sleep(duration_s)

    def progress(share: float) -> None:
        """Report the share of completed work, 0 to 1."""
        send("progress", share=min(1.0, max(0.0, float(share))))

    return {
        "robot": Robot(request, joints=task["joints"], frames=task["frames"], can=task["can"]),
        "room": Room(request),
        "parameters": task["parameters"],
        "wait": wait,
        "progress": progress,
        "RobotError": RobotError,
    }


def _numbers(values: Sequence[float], count: int, name: str) -> list[float]:
    if len(values) != count:
        raise RobotError(f"{name} needs {count} numbers, not {len(values)}")
    return [float(value) for value in values]
