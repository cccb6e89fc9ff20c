"""The Dynamixel bus, protocol 2.0, as far as LeRobot uses it: ping, read, write, sync read, sync write.

Source: ROBOTIS e-Manual, *DYNAMIXEL Protocol 2.0* and *XL430-W250*, *XL330-M288* (control tables). A packet is
``FF FF FD 00 id length instruction parameters CRC``; ``FF FF FD`` inside is followed by another ``FD``.
"""

from collections.abc import Callable, Mapping

from tests.harness.robots.lerobot.servo import Servo, Table

XL430, XL330 = 1060, 1200
"""Model numbers."""
TABLE = Table(
    registers={
        "Model_Number": (0, 2), "Firmware_Version": (6, 1), "ID": (7, 1), "Drive_Mode": (10, 1),
        "Operating_Mode": (11, 1), "Homing_Offset": (20, 4), "Max_Position_Limit": (48, 4),
        "Min_Position_Limit": (52, 4), "Torque_Enable": (64, 1), "Hardware_Error_Status": (70, 1),
        "Goal_Velocity": (104, 4), "Profile_Velocity": (112, 4), "Goal_Position": (116, 4),
        "Present_Velocity": (128, 4), "Present_Position": (132, 4), "Present_Input_Voltage": (144, 2),
        "Present_Temperature": (146, 1),
    },
    signed=dict.fromkeys(
        ("Homing_Offset", "Goal_Velocity", "Goal_Position", "Present_Velocity", "Present_Position")
    ),
    velocity_mode=1,
    status="Hardware_Error_Status",
    overload=32,
    impossible=0x7FFFFFFF,
    speed="Profile_Velocity",
    speed_unit=0.229 * 4096 / 60,
)  # fmt: skip
DEFAULTS = {"Firmware_Version": 47}
_ALERT = 0x80
_HEADER = b"\xff\xff\xfd\x00"
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
_PING, _READ, _WRITE, _SYNC_READ, _SYNC_WRITE, _STATUS = 1, 2, 3, 0x82, 0x83, 0x55


def crc(data: bytes) -> bytes:
    """CRC-16 with the polynomial 0x8005 and the initial value 0."""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x8005) & 0xFFFF if value & 0x8000 else value << 1
    return value.to_bytes(2, "little")


def split(received: bytes) -> tuple[list[bytes], bytes]:
    """Complete instructions (id, instruction, parameters), and the rest."""
    packets = []
    while (start := received.find(_HEADER)) >= 0 and len(received) > start + 7:
        end = start + 7 + int.from_bytes(received[start + 5 : start + 7], "little")
        if len(received) < end:
            break
        packet, received = received[start:end], received[end:]
        if crc(packet[:-2]) == packet[-2:]:
            packets.append(packet[4:5] + packet[7:-2].replace(_STUFFED, _PLAIN))
    return packets, received


def reply(servo_id: int, error: int, data: bytes) -> bytes:
    """A status packet."""
    body = (bytes((_STATUS, _ALERT if error else 0)) + data).replace(_PLAIN, _STUFFED)
    packet = _HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc(packet)


def execute(packet: bytes, servos: Mapping[int, Servo], read: Callable[[Servo, int, int], bytes]) -> list[bytes]:
    """Execute an instruction; returns the status packets."""
    servo_id, instruction, parameters = packet[0], packet[1], packet[2:]
    address, size = (int.from_bytes(parameters[start : start + 2], "little") for start in (0, 2))
    if instruction == _SYNC_READ:
        ids = parameters[4:]
        return [reply(each, servos[each].error, read(servos[each], address, size)) for each in ids if each in servos]
    if instruction == _SYNC_WRITE:
        for start in range(4, len(parameters), size + 1):
            if parameters[start] in servos:
                servos[parameters[start]].write(address, parameters[start + 1 : start + 1 + size])
        return []
    servo = servos.get(servo_id)
    if servo is None:
        return []
    if instruction == _WRITE:
        servo.write(address, parameters[2:])
    data = read(servo, address, size) if instruction == _READ else b""
    if instruction == _PING:
        data = bytes(servo.memory[0:2] + servo.memory[6:7])
    return [reply(servo_id, servo.error, data)]
