"""The robot of each protocol: ``python -m benchmarks.peers.robots rosbridge|zenoh|grpc|foxglove PORT``.

``… bridge PORT`` is the rosbridge server. Each program prints ``ready`` when it accepts requests.
"""

import asyncio
import json
import sys
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any, Final

from benchmarks.baseline.echo_servers import HOST
from benchmarks.peers import bridge
from benchmarks.peers.arm import NAMES, PeerArm
from device_agent.protocol import JointTarget, JointTelemetry, Setpoint

CONTROL: Final = "arm/control"
JOINTS: Final = "arm/joints"
ROS_TYPE: Final = "sensor_msgs/JointState"
METHOD: Final = ("bench.PeerArm", "Drive")


def rosbridge(port: int) -> None:
    """Serves the robot with ``roslibpy``; both messages are ``JointState``."""
    import roslibpy

    arm, ros = PeerArm(), roslibpy.Ros(host=HOST, port=port)
    ros.run()
    joints = roslibpy.Topic(ros, "/" + JOINTS, ROS_TYPE)
    control = roslibpy.Topic(ros, "/" + CONTROL, ROS_TYPE)
    joints.advertise()
    control.subscribe(lambda message: joints.publish(to_ros(arm.apply(from_ros(message)))))
    _ready()


def from_ros(message: Mapping[str, Any]) -> Setpoint:
    """Converts a ``JointState`` to a setpoint."""
    target = JointTarget(position_rad=dict(zip(message["name"], message["position"], strict=True)))
    return Setpoint(epoch=1, sequence=message["header"]["seq"], echo_tick_ms=0, sent_ms=0.0, target=target)


def to_ros(telemetry: JointTelemetry) -> dict[str, Any]:
    """Converts telemetry to a ``JointState``."""
    seconds, rest_ms = divmod(telemetry.at_ms, 1000)
    return {
        "header": {"seq": telemetry.setpoint_sequence, "stamp": {"secs": seconds, "nsecs": rest_ms * 1_000_000}},
        "name": NAMES,
        "position": telemetry.position_rad,
        "velocity": telemetry.velocity_rad_s,
        "effort": telemetry.effort_nm,
    }


def zenoh(port: int) -> None:
    """Serves the robot as a listening peer without a router."""
    import zenoh as library

    with library.open(zenoh_peer(listen=port)) as session:
        arm, joints = PeerArm(), session.declare_publisher(JOINTS, express=True)
        session.declare_subscriber(CONTROL, lambda sample: joints.put(arm.apply_encoded(sample.payload.to_bytes())))
        _ready()


def zenoh_peer(*, listen: int = 0, connect: int = 0) -> Any:
    """Returns a configuration with TCP on loopback only and without discovery."""
    import zenoh as library

    config = library.Config()
    for part, port in (("listen/endpoints", listen), ("connect/endpoints", connect)):
        config.insert_json5(part, json.dumps([f"tcp/{HOST}:{port}"] if port else []))
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


def grpc(port: int) -> None:
    """Serves the robot over a bidirectional stream of bytes, without the cost of protobuf."""

    async def serve() -> None:
        import grpc as library

        arm = PeerArm()

        async def drive(setpoints: AsyncIterator[bytes], _context: Any) -> AsyncIterator[bytes]:
            async for payload in setpoints:
                yield arm.apply_encoded(payload)

        server = library.aio.server()
        service, method = METHOD
        handler = library.stream_stream_rpc_method_handler(drive)
        server.add_generic_rpc_handlers((library.method_handlers_generic_handler(service, {method: handler}),))
        server.add_insecure_port(f"{HOST}:{port}")
        await server.start()
        print("ready", flush=True)
        await server.wait_for_termination()

    asyncio.run(serve())


def foxglove(port: int) -> None:
    """Serves the robot with the SDK's server: clients publish setpoints, and a channel carries telemetry."""
    import foxglove as library
    from foxglove.websocket import Capability

    arm, joints = PeerArm(), library.Channel(f"/{JOINTS}", message_encoding="json")

    class Listener(library.ServerListener):  # type: ignore[misc]
        def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
            del client, client_channel_id
            joints.log(arm.apply_encoded(data))

    library.start_server(
        name="arm",
        host=HOST,
        port=port,
        capabilities=[Capability.ClientPublish],
        server_listener=Listener(),
        supported_encodings=["json"],
    )
    _ready()


def _ready() -> None:
    print("ready", flush=True)
    threading.Event().wait()


KINDS: Final[Mapping[str, Callable[[int], None]]] = {
    "rosbridge": rosbridge,
    "zenoh": zenoh,
    "grpc": grpc,
    "foxglove": foxglove,
    "bridge": bridge.main,
}


if __name__ == "__main__":
    KINDS[sys.argv[1]](int(sys.argv[2]))
