"""Robots that only publish: ``python -m benchmarks.scale.publishers``.

The program reads one line of JSON (``PublisherOptions``), connects and prints ``ready``. For each further line with a
rate and a time it publishes and prints ``PublisherResult`` as JSON. A saturated broker delays the program.
"""

import random
import socket
import sys
import time
from typing import Final

import msgspec

from benchmarks.reporting.report import percentile
from benchmarks.scale import mqtt_packets
from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.protocol import JointTelemetry, Mode, Pose, codec

SENT: Final = b'"setpoint_sent_ms":'
"""Marks the send time [ms] on the common clock of the machine's processes."""
_POSES: Final = 7


class Robot(msgspec.Struct):
    """One publisher and its topic."""

    client: str
    user: str
    password: str
    topic: str


class PublisherOptions(msgspec.Struct):
    """All publishers."""

    port: int
    robots: list[Robot]


class PublisherResult(msgspec.Struct):
    """Result. ``late_ms``: 99 % of the messages were sent within this time after they were due."""

    sent: int
    late_ms: float
    duration_s: float
    processor_s: float
    message_bytes: int


def telemetry() -> bytes:
    """Telemetry like that of the simulated UR5: six joints and seven frames."""
    chance = random.Random(1)

    def some(count: int) -> tuple[float, ...]:
        return tuple(round(chance.uniform(-2, 2), 6) for _ in range(count))

    message = JointTelemetry(
        tick_ms=tick_ms(),
        at_ms=wall_ms(),
        sequence=12_345,
        mode=Mode.IDLE,
        position_rad=some(6),
        velocity_rad_s=some(6),
        effort_nm=some(6),
        commanded_rad=some(6),
        frames=tuple(msgspec.convert(some(7), Pose) for _ in range(_POSES)),
        epoch=7,
        setpoint_sent_ms=-1.0,
    )
    return codec.encode(message)


def publish(connections: list[tuple[socket.socket, str]], rate_hz: float, seconds: float) -> PublisherResult:
    """Publishes for all robots in turn, each at ``rate_hz``."""
    before, after = telemetry().split(SENT + b"-1.0")
    streams = [(connection, mqtt_packets.text(topic) + before + SENT) for connection, topic in connections]
    count, gap_s = round(len(streams) * rate_hz * seconds), 1 / (len(streams) * rate_hz)
    late, clock = [], time.monotonic
    spent_s, started_s = time.process_time(), clock()
    size = 0
    for number in range(count):
        due_s = started_s + number * gap_s
        now_s = clock()
        if now_s < due_s:
            time.sleep(due_s - now_s)
            now_s = clock()
        connection, start = streams[number % len(streams)]
        packet = mqtt_packets.packet(mqtt_packets.PUBLISH, b"%b%.3f%b" % (start, now_s * 1000, after))
        connection.sendall(packet)
        size = len(packet)
        late.append(now_s - due_s)
    return PublisherResult(
        sent=count,
        late_ms=percentile(late, 0.99) * 1000,
        duration_s=clock() - started_s,
        processor_s=time.process_time() - spent_s,
        message_bytes=size,
    )


def main() -> None:
    """Runs until standard input ends."""
    fleet = msgspec.json.decode(sys.stdin.readline(), type=PublisherOptions)
    connections = [
        (mqtt_packets.connect(fleet.port, each.client, each.user, each.password), each.topic) for each in fleet.robots
    ]
    print("ready", flush=True)
    for line in sys.stdin:
        rate_hz, seconds = map(float, line.split())
        print(msgspec.json.encode(publish(connections, rate_hz, seconds)).decode(), flush=True)


if __name__ == "__main__":
    main()
