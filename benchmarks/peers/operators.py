"""Operators of each protocol: send a setpoint and wait until telemetry reports it as applied."""

import contextlib
import json
import queue
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Final

from benchmarks.baseline.echo_servers import HOST
from benchmarks.baseline.interleaved import Exchange
from benchmarks.baseline.product import PERIOD_S, TIMEOUT_S, start_peer
from benchmarks.peers.arm import HOME_RAD, NAMES, setpoint
from benchmarks.peers.robots import CONTROL, JOINTS, METHOD, ROS_TYPE, zenoh_peer
from device_agent.protocol import JointTelemetry, codec
from tests.harness.network.ports import free_port

_PROGRAM: Final = "benchmarks.peers.robots"
_CHANNEL_ID: Final = 1
"""Id of the client's channel and subscription in Foxglove frames."""
_DATA: Final = 1
"""First byte of a Foxglove message frame."""


class PeerOperator:
    """Sends setpoints at the console's rate and waits for telemetry.

    Args:
        send: Sends one setpoint with this sequence number.
    """

    def __init__(self, send: Callable[[int], None]) -> None:
        self._send = send
        self._telemetry_received = threading.Condition()
        self._applied = 0
        self._sequence = 0
        self._next_s = 0.0

    def on_applied(self, applied: int) -> None:
        """Records the newest applied setpoint. Thread-safe."""
        with self._telemetry_received:
            self._applied = applied
            self._telemetry_received.notify()

    def exchange(self) -> float:
        """Runs one exchange and returns its duration [ms].

        Raises:
            TimeoutError: No telemetry reports the setpoint.
        """
        time.sleep(max(0.0, self._next_s - time.monotonic()))
        self._next_s = time.monotonic() + PERIOD_S
        started_s = time.perf_counter()
        with self._telemetry_received:
            self._sequence += 1
            self._send(self._sequence)
            if not self._telemetry_received.wait_for(lambda: self._applied >= self._sequence, TIMEOUT_S):
                raise TimeoutError(f"setpoint {self._sequence} is not reported by telemetry")
        return (time.perf_counter() - started_s) * 1000

    def settle(self) -> Exchange:
        """Returns the exchange after a first success; a channel may open before the other end is connected."""
        deadline_s = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline_s:
            with self._telemetry_received:
                self._sequence += 1
                self._send(self._sequence)
                if self._telemetry_received.wait_for(lambda: self._applied >= self._sequence, 0.2):
                    return self.exchange
        raise TimeoutError("the robot sends no telemetry")


def _encoded(sequence: int) -> bytes:
    return codec.encode(setpoint(sequence, time.monotonic() * 1000))


def _applied(payload: bytes) -> int:
    return codec.decode(payload, JointTelemetry).setpoint_sequence


@contextlib.contextmanager
def rosbridge() -> Iterator[Exchange]:
    """rosbridge: robot and operator are both clients of the bridge, as in ROS."""
    import roslibpy

    port = free_port()
    with start_peer(_PROGRAM, "bridge", str(port)), start_peer(_PROGRAM, "rosbridge", str(port)):
        ros = roslibpy.Ros(host=HOST, port=port)
        ros.run()
        control = roslibpy.Topic(ros, "/" + CONTROL, ROS_TYPE)
        control.advertise()

        def send(sequence: int) -> None:
            now_ms = time.time_ns() // 1_000_000
            stamp = {"secs": now_ms // 1000, "nsecs": now_ms % 1000 * 1_000_000}
            control.publish({"header": {"seq": sequence, "stamp": stamp}, "name": NAMES, "position": HOME_RAD})

        operator = PeerOperator(send)
        roslibpy.Topic(ros, "/" + JOINTS, ROS_TYPE).subscribe(
            lambda message: operator.on_applied(message["header"]["seq"])
        )
        yield operator.settle()
        ros.close()


@contextlib.contextmanager
def zenoh() -> Iterator[Exchange]:
    """Zenoh, peer to peer over TCP."""
    import zenoh as library

    port = free_port()
    with start_peer(_PROGRAM, "zenoh", str(port)), library.open(zenoh_peer(connect=port)) as session:
        control = session.declare_publisher(CONTROL, express=True)
        operator = PeerOperator(lambda sequence: control.put(_encoded(sequence)))
        session.declare_subscriber(JOINTS, lambda sample: operator.on_applied(_applied(sample.payload.to_bytes())))
        yield operator.settle()


@contextlib.contextmanager
def grpc() -> Iterator[Exchange]:
    """gRPC: one bidirectional stream."""
    import grpc as library

    port = free_port()
    setpoints: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    with start_peer(_PROGRAM, "grpc", str(port)), library.insecure_channel(f"{HOST}:{port}") as channel:
        telemetry = channel.stream_stream("/" + "/".join(METHOD))(iter(setpoints.get, None), wait_for_ready=True)
        operator = PeerOperator(lambda sequence: setpoints.put(_encoded(sequence)))

        def listen() -> None:
            with contextlib.suppress(library.RpcError):  # end of the stream
                for payload in telemetry:
                    operator.on_applied(_applied(payload))

        listening = threading.Thread(target=listen)
        listening.start()
        yield operator.settle()
        setpoints.put(None)
        telemetry.cancel()
        listening.join(TIMEOUT_S)


@contextlib.contextmanager
def foxglove() -> Iterator[Exchange]:
    """Foxglove WebSocket: advertises a channel for setpoints and subscribes to the joints."""
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    port = free_port()
    with (
        start_peer(_PROGRAM, "foxglove", str(port)),
        connect(
            f"ws://{HOST}:{port}", subprotocols=[Subprotocol("foxglove.sdk.v1")], compression=None, close_timeout=1
        ) as connection,
    ):
        channel = _channel(connection)
        channel_info = {"id": _CHANNEL_ID, "topic": f"/{CONTROL}", "encoding": "json", "schemaName": ""}
        connection.send(json.dumps({"op": "advertise", "channels": [channel_info]}))
        connection.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": _CHANNEL_ID, "channelId": channel}]}))
        operator = PeerOperator(
            lambda sequence: connection.send(struct.pack("<BI", _DATA, _CHANNEL_ID) + _encoded(sequence))
        )

        def listen() -> None:
            with contextlib.suppress(ConnectionClosed):
                for frame in connection:
                    if isinstance(frame, bytes) and frame[0] == _DATA:
                        operator.on_applied(_applied(frame[1 + 4 + 8 :]))

        listening = threading.Thread(target=listen)
        listening.start()
        yield operator.settle()
        connection.close()
        listening.join(TIMEOUT_S)


def _channel(connection: Any) -> int:
    """Returns the id of the joints' channel that the server advertises."""
    while True:
        message = json.loads(connection.recv(TIMEOUT_S))
        for each in message.get("channels", ()) if message["op"] == "advertise" else ():
            if each["topic"] == f"/{JOINTS}":
                return int(each["id"])
