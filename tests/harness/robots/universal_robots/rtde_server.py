"""RTDE server of the emulated controller, from the manufacturer's guide; independent of the driver's code."""

import math
import struct
from collections.abc import Sequence

from device_agent.drivers.testing.peer import Disturbance
from tests.harness.robots.universal_robots.controller import CYCLE_S, JOINTS, Controller

_TYPES = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "UINT64": "Q", "UINT8": "B"}
_OUTPUT_TYPES = {
    "timestamp": "DOUBLE",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "target_moment": "VECTOR6D",
    "joint_temperatures": "VECTOR6D",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "runtime_state": "UINT32",
    "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64",
    "tool_analog_input0": "DOUBLE",
    "tool_analog_input1": "DOUBLE",
    "tool_output_voltage": "INT32",
    **{f"output_int_register_{index}": "INT32" for index in range(48)},
}
_INPUT_TYPES = {
    **{f"input_int_register_{index}": "INT32" for index in range(48)},
    **{f"input_double_register_{index}": "DOUBLE" for index in range(48)},
    **{f"{bank}_digital_output{part}": "UINT8" for bank in ("standard", "tool") for part in ("_mask", "")},
}
TEXT_MESSAGE = b"\x05Hello\x04Test\x03"


class RtdeServer:
    """The protocol on the side of the controller, for several clients.

    Attributes:
        versions: Supported protocol versions.
        missing: Variables that this controller does not have.
        taken: Inputs that another client writes, for example a fieldbus adapter.
    """

    def __init__(self, controller: Controller) -> None:
        self.controller = controller
        self.versions = {1, 2}
        self.missing: set[str] = set()
        self.taken: set[str] = set()

    def output_type(self, name: str) -> str:
        """Type of an output."""
        return "NOT_FOUND" if name in self.missing else _OUTPUT_TYPES.get(name, "NOT_FOUND")

    def input_type(self, name: str) -> str:
        """Type of an input; ``IN_USE`` if another client writes it."""
        if name in self.taken:
            return "IN_USE"
        return "NOT_FOUND" if name in self.missing else _INPUT_TYPES.get(name, "NOT_FOUND")

    def values(self, names: Sequence[str]) -> list[float]:
        """Values of outputs, vectors flattened."""
        controller = self.controller
        known: dict[str, Sequence[float]] = {
            "timestamp": [controller.time_s],
            "actual_q": controller.position,
            "actual_qd": controller.velocity,
            "target_moment": [1.0] * JOINTS,
            "joint_temperatures": [30.0 + joint for joint in range(JOINTS)],
            "robot_mode": [controller.robot_mode],
            "safety_mode": [controller.safety_mode],
            "runtime_state": [controller.runtime_state],
            "actual_digital_input_bits": [controller.digital_inputs],
            "actual_digital_output_bits": [controller.digital_outputs],
            "tool_analog_input0": [1.5],
            "tool_analog_input1": [0.25],
            "tool_output_voltage": [24],
        }
        values: list[float] = []
        for name in names:
            values += known[name] if name in known else [controller.integer_outputs[int(name.rpartition("_")[2])]]
        return values

    def write(self, names: Sequence[str], values: Sequence[float]) -> None:
        """Write inputs."""
        if names[0].endswith("_digital_output_mask"):
            shift = 16 if names[0].startswith("tool") else 0
            mask, bits = int(values[0]) << shift, int(values[1]) << shift
            if self.controller.outputs_follow:
                self.controller.digital_outputs = self.controller.digital_outputs & ~mask | bits & mask
            return
        for name, value in zip(names, values, strict=True):
            index = int(name.rpartition("_")[2])
            if "_int_" in name:
                self.controller.integer_inputs[index] = int(value)
            else:
                self.controller.float_inputs[index] = value


class RtdeSession:
    """One client of the server: bytes in, bytes out."""

    def __init__(self, server: RtdeServer) -> None:
        self._server = server
        self._buffer = b""
        self._outputs: list[str] = []
        self._inputs: dict[int, list[str]] = {}
        self._started = False
        self._period_s = 0.008
        self._next_s = -math.inf
        self._old_time_s = server.controller.time_s

    def receive(self, data: bytes) -> bytes:
        """Process received bytes. Returns the responses."""
        self._buffer += data
        responses = b""
        while len(self._buffer) >= 3:
            size, kind = struct.unpack(">Hc", self._buffer[:3])
            if len(self._buffer) < size:
                break
            payload, self._buffer = self._buffer[3:size], self._buffer[size:]
            response = self._respond(kind, payload)
            if response is not None:
                responses += _package(b"M", TEXT_MESSAGE) + _package(kind, response)
        return responses

    def data(self, disturbance: Disturbance | None) -> bytes:
        """What this client receives in this cycle."""
        controller = self._server.controller
        if disturbance is not Disturbance.CLOCK:
            self._old_time_s = controller.time_s
        if not self._started or disturbance is Disturbance.SILENCE or controller.time_s < self._next_s:
            return b""
        self._next_s = controller.time_s + self._period_s - CYCLE_S / 2
        if disturbance is Disturbance.GARBAGE:
            return b"\x00\xffgarbage\n"
        values = self._server.values(self._outputs)
        if disturbance is Disturbance.CLOCK:
            values[self._outputs.index("timestamp")] = self._old_time_s
        if disturbance is Disturbance.NAN:
            values[1] = math.nan
        layout = ">" + "".join(_TYPES[self._server.output_type(name)] for name in self._outputs)
        sent = _package(b"U", b"\x01" + struct.pack(layout, *values))
        return sent[: len(sent) // 2] if disturbance is Disturbance.TRUNCATED else sent

    def _respond(self, kind: bytes, payload: bytes) -> bytes | None:
        server = self._server
        if kind == b"V":
            return bytes([struct.unpack(">H", payload)[0] in server.versions])
        if kind == b"O":
            self._period_s = 1 / struct.unpack(">d", payload[:8])[0]
            self._outputs = payload[8:].decode().split(",")
            types = [server.output_type(name) for name in self._outputs]
            return bytes(["NOT_FOUND" not in types]) + ",".join(types).encode()
        if kind == b"I":
            names = payload.decode().split(",")
            types = [server.input_type(name) for name in names]
            valid = not {"NOT_FOUND", "IN_USE"} & set(types)
            if valid:
                self._inputs[len(self._inputs) + 1] = names
            return bytes([len(self._inputs) if valid else 0]) + ",".join(types).encode()
        if kind == b"S":
            self._started = True
            return b"\x01"
        if kind == b"U":
            names = self._inputs[payload[0]]
            layout = ">" + "".join(_TYPES[_INPUT_TYPES[name]] for name in names)
            server.write(names, struct.unpack(layout, payload[1:]))
        return None


def _package(kind: bytes, payload: bytes) -> bytes:
    return struct.pack(">Hc", 3 + len(payload), kind) + payload
