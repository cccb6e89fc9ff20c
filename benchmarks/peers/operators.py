"""Who asks at each peer's wire: a setpoint, until the answer on the telemetry's channel says that it is applied."""

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
from benchmarks.baseline.product import PERIOD_S, TIMEOUT_S, free_port, start_peer
from benchmarks.peers.arm import HOME_RAD, NAMES, setpoint
from benchmarks.peers.robots import CONTROL, JOINTS, METHOD, ROS_TYPE, zenoh_peer
from device_agent.protocol import JointTelemetry, codec

_PROGRAM: Final = "benchmarks.peers.robots"
_OURS: Final = 1
"""The number of our channel, and of our subscription, in Foxglove's frames."""
_DATA: Final = 1
"""Their first byte, where they bring a message."""


class PeerOperator:
    """Paces itself as our own page does, and waits for what comes on the other channel.

    Args:
        send: Bring one setpoint of this sequence on its way.
    """

    def __init__(self, send: Callable[[int], None]) -> None:
        self._send = send
        self._seen = threading.Condition()
        self._applied = 0
        self._sequence = 0
        self._next_s = 0.0

    def hear(self, applied: int) -> None:
        """The robot tells the newest setpoint that it has applied. From any thread."""
        with self._seen:
            self._applied = applied
            self._seen.notify()

    def exchange(self) -> float:
        """One round [ms]. Raises: TimeoutError: Nothing came back."""
        time.sleep(max(0.0, self._next_s - time.monotonic()))
        self._next_s = time.monotonic() + PERIOD_S
        began = time.perf_counter()
        with self._seen:
            self._sequence += 1
            self._send(self._sequence)
            if not self._seen.wait_for(lambda: self._applied >= self._sequence, TIMEOUT_S):
                raise TimeoutError(f"setpoint {self._sequence} is not seen again")
        return (time.perf_counter() - began) * 1000

    def settle(self) -> Exchange:
        """The exchange, once it works: a channel may be open before the other end knows of it."""
        ends_s = time.monotonic() + TIMEOUT_S
        while time.monotonic() < ends_s:
            with self._seen:
                self._sequence += 1
                self._send(self._sequence)
                if self._seen.wait_for(lambda: self._applied >= self._sequence, 0.2):
                    return self.exchange
        raise TimeoutError("the robot does not answer")


def _asked(sequence: int) -> bytes:
    return codec.encode(setpoint(sequence, time.monotonic() * 1000))


def _applied(payload: bytes) -> int:
    return codec.decode(payload, JointTelemetry).setpoint_sequence


@contextlib.contextmanager
def rosbridge() -> Iterator[Exchange]:
    """Robot and operator are both clients of the bridge, as in ROS."""
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
        roslibpy.Topic(ros, "/" + JOINTS, ROS_TYPE).subscribe(lambda told: operator.hear(told["header"]["seq"]))
        yield operator.settle()
        ros.close()


@contextlib.contextmanager
def zenoh() -> Iterator[Exchange]:
    """Peer to peer over TCP."""
    import zenoh as library

    port = free_port()
    with start_peer(_PROGRAM, "zenoh", str(port)), library.open(zenoh_peer(connect=port)) as session:
        control = session.declare_publisher(CONTROL, express=True)
        operator = PeerOperator(lambda sequence: control.put(_asked(sequence)))
        session.declare_subscriber(JOINTS, lambda told: operator.hear(_applied(told.payload.to_bytes())))
        yield operator.settle()


@contextlib.contextmanager
def grpc() -> Iterator[Exchange]:
    """One stream, held open."""
    import grpc as library

    port = free_port()
    asked: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    with start_peer(_PROGRAM, "grpc", str(port)), library.insecure_channel(f"{HOST}:{port}") as channel:
        told = channel.stream_stream("/" + "/".join(METHOD))(iter(asked.get, None), wait_for_ready=True)
        operator = PeerOperator(lambda sequence: asked.put(_asked(sequence)))

        def listen() -> None:
            with contextlib.suppress(library.RpcError):  # the stream's end
                for payload in told:
                    operator.hear(_applied(payload))

        listening = threading.Thread(target=listen)
        listening.start()
        yield operator.settle()
        asked.put(None)
        told.cancel()
        listening.join(TIMEOUT_S)


@contextlib.contextmanager
def foxglove() -> Iterator[Exchange]:
    """A client of its subprotocol: it advertises the channel of its setpoints, and subscribes to the joints'."""
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    port = free_port()
    with (
        start_peer(_PROGRAM, "foxglove", str(port)),
        connect(
            f"ws://{HOST}:{port}", subprotocols=[Subprotocol("foxglove.sdk.v1")], compression=None, close_timeout=1
        ) as line,
    ):
        channel = _channel(line)
        mine = {"id": _OURS, "topic": f"/{CONTROL}", "encoding": "json", "schemaName": ""}
        line.send(json.dumps({"op": "advertise", "channels": [mine]}))
        line.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": _OURS, "channelId": channel}]}))
        operator = PeerOperator(lambda sequence: line.send(struct.pack("<BI", _DATA, _OURS) + _asked(sequence)))

        def listen() -> None:
            with contextlib.suppress(ConnectionClosed):
                for frame in line:
                    if isinstance(frame, bytes) and frame[0] == _DATA:
                        operator.hear(_applied(frame[1 + 4 + 8 :]))

        listening = threading.Thread(target=listen)
        listening.start()
        yield operator.settle()
        line.close()
        listening.join(TIMEOUT_S)


def _channel(line: Any) -> int:
    """The number of the joints' channel, which the server advertises of its own accord."""
    while True:
        said = json.loads(line.recv(TIMEOUT_S))
        for each in said.get("channels", ()) if said["op"] == "advertise" else ():
            if each["topic"] == f"/{JOINTS}":
                return int(each["id"])
