"""The Feetech bus, as far as LeRobot uses it: ping, read, write, sync read, sync write.

Sources: Feetech, *Communication Protocol User Manual* (packets), and *STS3215 memory table* (addresses). A packet is
``FF FF id length instruction|error parameters checksum``; the checksum is the inverted sum of all but the header.
"""

from collections.abc import Callable, Mapping

from tests.harness.robots.lerobot.servo import Servo, Table

MODEL = 777
"""Model number of an STS3215."""
TABLE = Table(
    registers={
        "Firmware_Major_Version": (0, 1), "Firmware_Minor_Version": (1, 1), "Model_Number": (3, 2), "ID": (5, 1),
        "Min_Position_Limit": (9, 2), "Max_Position_Limit": (11, 2), "Homing_Offset": (31, 2),
        "Operating_Mode": (33, 1), "Torque_Enable": (40, 1), "Goal_Position": (42, 2), "Goal_Velocity": (46, 2),
        "Lock": (55, 1), "Present_Position": (56, 2), "Present_Velocity": (58, 2), "Present_Voltage": (62, 1),
        "Present_Temperature": (63, 1), "Status": (65, 1),
    },
    signed={"Homing_Offset": 11, "Goal_Position": 15, "Goal_Velocity": 15, "Present_Position": 15,
            "Present_Velocity": 15},
    velocity_mode=1,
    status="Status",
    overload=32,
    impossible=32767,
    speed="Goal_Velocity",
    speed_unit=1.0,
)  # fmt: skip
DEFAULTS = {"Model_Number": MODEL, "Firmware_Major_Version": 3, "Firmware_Minor_Version": 10}
_BROADCAST = 254
_READ, _WRITE, _SYNC_READ, _SYNC_WRITE = 2, 3, 0x82, 0x83


def checksum(body: bytes) -> int:
    """Checksum of a packet without its header."""
    return ~sum(body) & 0xFF


def split(received: bytes) -> tuple[list[bytes], bytes]:
    """Complete instructions without header and checksum, and the rest."""
    packets = []
    while (start := received.find(b"\xff\xff")) >= 0 and len(received) > start + 3:
        end = start + 4 + received[start + 3]
        if len(received) < end:
            break
        body, received = received[start + 2 : end], received[end:]
        if checksum(body[:-1]) == body[-1]:
            packets.append(body[:-1])
    return packets, received


def reply(servo_id: int, error: int, data: bytes) -> bytes:
    """A status packet."""
    body = bytes((servo_id, len(data) + 2, error)) + data
    return b"\xff\xff" + body + bytes((checksum(body),))


def execute(packet: bytes, servos: Mapping[int, Servo], read: Callable[[Servo, int, int], bytes]) -> list[bytes]:
    """Execute an instruction; returns the status packets."""
    servo_id, _, instruction, *rest = packet
    parameters = bytes(rest)
    servo = servos.get(servo_id)
    if instruction == _SYNC_READ:
        address, size, *ids = parameters
        return [reply(each, servos[each].error, read(servos[each], address, size)) for each in ids if each in servos]
    if instruction == _SYNC_WRITE:
        address, size = parameters[:2]
        for start in range(2, len(parameters), size + 1):
            if parameters[start] in servos:
                servos[parameters[start]].write(address, parameters[start + 1 : start + 1 + size])
        return []
    if servo is None or servo_id == _BROADCAST:
        return []
    if instruction == _WRITE:
        servo.write(parameters[0], parameters[1:])
    data = read(servo, parameters[0], parameters[1]) if instruction == _READ else b""
    return [reply(servo_id, servo.error, data)]
