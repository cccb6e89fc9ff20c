"""The Foxglove endpoint follows Foxglove's protocol and schemas, and serves only what an account may view."""

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import foxglove
import pytest
import simplejpeg
from foxglove.messages import JointStates, Log

from device_agent.protocol import (
    CameraStream,
    Description,
    Event,
    Joint,
    JointTelemetry,
    Mode,
    camera_frames,
    codec,
    topics,
)
from device_agent.protocol.camera_frames import CameraFrame
from infra import viewer
from infra.foxglove.endpoint import Endpoint
from tests.contract.exports.foxglove_client import FoxgloveClient, SchemaError
from tests.fakes.agent import Robot
from tests.harness.agent.recordings.synthetic import pixels
from tests.harness.cloud.cloud import Person
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.paths import ROOT

AT_MS = 1_790_000_000_123
TICK_MS = 5_000
JPEG = simplejpeg.encode_jpeg(pixels(1), colorsubsampling="444")


def description() -> Description:
    joints = [
        Joint(
            name=name, label=name.title(), lower_rad=-3.0, upper_rad=3.0, max_velocity_rad_s=1.0,
            max_acceleration_rad_s2=1.0, max_jerk_rad_s3=1.0, max_effort_nm=1.0,
        )
        for name in ("base", "elbow")
    ]  # fmt: skip
    return Description(
        device="arm", kind="arm", robot_type="ur5", label="Arm", joints=tuple(joints), frames=("tool",),
        cameras=(CameraStream(name="wrist", rate_hz=5.0),),
    )  # fmt: skip


def telemetry(**changes: Any) -> JointTelemetry:
    values: dict[str, Any] = {
        "tick_ms": TICK_MS, "at_ms": AT_MS, "sequence": 1, "mode": Mode.HOLDING, "position_rad": (0.5, -1.25),
        "velocity_rad_s": (0.1, 0.2), "effort_nm": (), "commanded_rad": (0.5, -1.25),
        "frames": ((1.0, 2.0, 3.0, 0.5, 0.1, 0.2, 0.3),),
    }  # fmt: skip
    return JointTelemetry(**values | changes)


def event(message: str, at_ms: int = AT_MS) -> Event:
    return Event(id="e1", device="arm", at_ms=at_ms, kind="motion-held", severity="warning", message=message)


def frame(kind: str = camera_frames.COLOUR) -> bytes:
    return camera_frames.encode(CameraFrame(1, TICK_MS + 40, 64, 48, JPEG, kind))


class LocalEndpoint:
    """The endpoint in this process, and the messages of a robot."""

    def __init__(self, context: foxglove.Context, url: str) -> None:
        self.context, self.url = context, url
        self.target = Endpoint(context, ["a-arm"])

    def send(self, kind: str, payload: Any, name: str = "", *, device: str = "arm") -> None:
        content = payload if isinstance(payload, bytes) else codec.encode(payload)
        self.target.receive(topics.device("s", "a", device, kind, name), content)

    def send_all(self) -> None:
        self.send(topics.DESC, description())
        self.send(topics.TELE, telemetry(), topics.JOINTS)
        self.send(topics.CAM, frame(), "wrist")
        self.send(topics.EVENT, event("held"))


@pytest.fixture
def endpoint() -> Iterator[LocalEndpoint]:
    context = foxglove.Context()
    server = foxglove.start_server(host="127.0.0.1", port=0, context=context)
    local = LocalEndpoint(context, f"ws://127.0.0.1:{server.port}")
    local.send_all()  # advertises the channels
    yield local
    local.target.close()
    server.stop()


SCHEMAS = {
    "/a-arm/joint_states": "foxglove.JointStates",
    "/a-arm/transforms": "foxglove.FrameTransforms",
    "/a-arm/cam/wrist": "foxglove.CompressedImage",
    "/a-arm/events": "foxglove.Log",
}


@contextlib.contextmanager
def subscribed(endpoint: LocalEndpoint) -> Iterator[FoxgloveClient]:
    """A client whose subscriptions are in effect."""
    with FoxgloveClient(endpoint.url) as client:
        client.receive(lambda: client.schemas == SCHEMAS, "channels")

        def all_arrive() -> bool:
            endpoint.send_all()
            return set(client.received) == set(SCHEMAS)

        client.receive(all_arrive, "messages of all channels")
        yield client


def test_every_message_follows_the_advertised_schema(endpoint: LocalEndpoint) -> None:
    with subscribed(endpoint) as client:
        assert client.server["capabilities"] == []
        states = client.received["/a-arm/joint_states"][-1]
        transforms = client.received["/a-arm/transforms"][-1]
        image = client.received["/a-arm/cam/wrist"][-1]
        log = client.received["/a-arm/events"][-1]
    assert [(joint.name, joint.position) for joint in states.joints] == [("base", 0.5), ("elbow", -1.25)]
    assert [joint.velocity for joint in states.joints] == [0.1, 0.2]
    assert not any(joint.HasField("effort") for joint in states.joints), "the robot measures no efforts"
    assert states.timestamp.ToMilliseconds() == AT_MS
    (transform,) = transforms.transforms
    assert (transform.parent_frame_id, transform.child_frame_id) == ("a-arm/base", "a-arm/tool")
    assert (transform.translation.x, transform.translation.y, transform.translation.z) == (1.0, 2.0, 3.0)
    rotation = transform.rotation
    assert (rotation.w, rotation.x, rotation.y, rotation.z) == (0.5, 0.1, 0.2, 0.3)
    assert (image.data, image.format, image.frame_id) == (JPEG, "jpeg", "a-arm/wrist")
    assert image.timestamp.ToMilliseconds() == AT_MS + 40
    assert (log.message, log.name) == ("held", "a-arm/motion-held")
    assert log.DESCRIPTOR.fields_by_name["level"].enum_type.values_by_number[log.level].name == "WARNING"


@pytest.mark.parametrize(
    "planted",
    [
        Log(message="a text instead of joints", name="x", line=7).encode(),
        JointStates().encode() + b"\xfa\x01\x03abc",  # field 31, which no schema has
        b"\x12\x02\x0a",  # a truncated joint
    ],
    ids=["other-message", "unknown-field", "truncated"],
)
def test_a_planted_wrong_field_is_found(endpoint: LocalEndpoint, planted: bytes) -> None:
    channel = endpoint.target._devices["a-arm"].channels["joint_states"]
    channel.close()
    wrong = foxglove.Channel(
        "/a-arm/planted", message_encoding="protobuf", schema=JointStates.get_schema(), context=endpoint.context
    )
    with FoxgloveClient(endpoint.url) as client, pytest.raises(SchemaError):
        client.receive(lambda: wrong.log(planted), "a planted message")


def test_a_schema_that_is_not_foxgloves_is_found(endpoint: LocalEndpoint) -> None:
    schema = foxglove.Schema(name="foxglove.JointStates", encoding="protobuf", data=Log.get_schema().data)
    channel = foxglove.Channel("/a-arm/planted", message_encoding="protobuf", schema=schema, context=endpoint.context)
    with FoxgloveClient(endpoint.url) as client, pytest.raises(SchemaError, match="which is not Foxglove's"):
        client.receive(lambda: False, "a planted channel")
    channel.close()


def test_other_devices_other_frames_and_invalid_messages_are_left_out(
    endpoint: LocalEndpoint, caplog: pytest.LogCaptureFixture
) -> None:
    with subscribed(endpoint) as client:
        endpoint.send(topics.DESC, description(), device="leg")
        endpoint.send(topics.TELE, telemetry(), topics.JOINTS, device="leg")
        endpoint.send(topics.CAM, frame(camera_frames.DEPTH), "depth")
        endpoint.send(topics.TELE, b"{}", topics.JOINTS)
        endpoint.send(topics.TELE, telemetry(position_rad=(0.5,)), topics.JOINTS)
        endpoint.send(topics.EVENT, event("after"))
        client.receive(lambda: client.received["/a-arm/events"][-1].message == "after", "the last event")
        assert client.schemas == SCHEMAS
        assert all(len(states.joints) == 2 for states in client.received["/a-arm/joint_states"])
    assert len(caplog.records) == 2
    assert all(record.levelname == "WARNING" for record in caplog.records)


@pytest.mark.parametrize("at_ms", [-1, 2**32 * 1_000, 2**53 - 1])
def test_times_that_foxglove_cannot_express_are_left_out(
    endpoint: LocalEndpoint, caplog: pytest.LogCaptureFixture, at_ms: int
) -> None:
    with subscribed(endpoint) as client:
        endpoint.send(topics.TELE, telemetry(at_ms=at_ms), topics.JOINTS)
        endpoint.send(topics.EVENT, event("wrong", at_ms))
        assert [record.levelname for record in caplog.records] == ["WARNING", "WARNING"]
        endpoint.send(topics.CAM, frame(), "wrist")
        endpoint.send(topics.EVENT, event("after"))
        client.receive(lambda: client.received["/a-arm/events"][-1].message == "after", "the last event")
        assert all(log.message != "wrong" for log in client.received["/a-arm/events"])
        image = client.received["/a-arm/cam/wrist"][-1]
    assert image.timestamp.ToMilliseconds() == AT_MS + 40, "the refused time must not move the images"


@pytest.mark.parametrize(("at_ms", "tick_ms"), [(AT_MS, 2**42), (0, 0)], ids=["after-2106", "before-1970"])
def test_an_image_whose_time_foxglove_cannot_express_is_left_out(
    endpoint: LocalEndpoint, caplog: pytest.LogCaptureFixture, at_ms: int, tick_ms: int
) -> None:
    endpoint.send(topics.TELE, telemetry(at_ms=at_ms), topics.JOINTS)
    image = camera_frames.encode(CameraFrame(1, tick_ms, 64, 48, JPEG, camera_frames.COLOUR))
    endpoint.send(topics.CAM, image, "wrist")
    (record,) = caplog.records
    assert record.levelname == "WARNING"


@pytest.mark.parametrize("at_ms", [0, 2**32 * 1_000 - 1])
def test_the_first_and_the_last_time_are_published(
    endpoint: LocalEndpoint, caplog: pytest.LogCaptureFixture, at_ms: int
) -> None:
    with subscribed(endpoint) as client:
        endpoint.send(topics.EVENT, event("limit", at_ms))
        client.receive(lambda: client.received["/a-arm/events"][-1].message == "limit", "the event")
        assert client.received["/a-arm/events"][-1].timestamp.ToMilliseconds() == at_ms
    assert not caplog.records


# ------------------------------------------------------------ the program


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CloudProcesses]:
    with start_cloud_processes("amqtt", tmp_path_factory.mktemp("cloud")) as processes:
        yield processes


@pytest.fixture(scope="module")
def robot(processes: CloudProcesses) -> Robot:
    """Anna's connected robot, whose description is retained."""
    robot = processes.cloud.robot("arm")
    robot.pair(processes.anna)
    robot.connect()
    robot.publish(robot.topic(topics.DESC), description(), retain=True)
    return robot


def api_key(person: Person) -> str:
    token: str = person.post("/api-keys", {"name": "Foxglove", "role": "viewer"}).json()["token"]
    return token


@contextlib.contextmanager
def start(
    processes: CloudProcesses, key: str, *options: str, program: tuple[str, str] = ("-m", "infra.foxglove")
) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, *program, "--server", processes.url, "--port", "0", *options]
    with subprocess.Popen(
        command, cwd=ROOT, env=os.environ | {"TELESCOPE_KEY": key}, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


def ready(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    word, _, url = process.stdout.readline().strip().partition(" ")
    assert word == "ready", process.stderr.read() if process.stderr is not None else ""
    return url


def test_a_viewer_sees_the_robot_until_the_share_ends(processes: CloudProcesses, robot: Robot) -> None:
    bert = processes.cloud.sign_in("bert")
    share = {"account": "bert", "role": "viewer"}
    shared = processes.anna.post(f"/devices/{robot.device}/shares", share)
    assert shared.status_code == 201, shared.text
    with start(processes, api_key(bert), "--device", robot.device) as process:
        with FoxgloveClient(ready(process)) as client:
            sequence = 0

            def positions_arrive() -> bool:
                nonlocal sequence
                sequence += 1
                robot.publish(topics.device(robot.space, robot.id, "arm", topics.TELE, topics.JOINTS), telemetry())
                robot.publish(topics.device(robot.space, robot.id, "arm", topics.EVENT), event(f"event {sequence}"))
                return set(client.received) >= {f"/{robot.device}/joint_states", f"/{robot.device}/events"}

            client.receive(positions_arrive, "positions and events")
            states = client.received[f"/{robot.device}/joint_states"][-1]
            assert [joint.position for joint in states.joints] == [0.5, -1.25]
            ended = processes.anna.delete(f"/devices/{robot.device}/shares/{bert.account}")
            assert ended.is_success, ended.text
            client.receive(lambda: client.closed, "the end of the connection")
        assert process.wait(60) == 4
        assert process.stderr is not None
        assert f"this account may not view {robot.device}" in process.stderr.read()


@pytest.mark.usefixtures("robot")
def test_an_unexpected_error_of_the_receiver_is_logged_and_ends_the_connection(
    processes: CloudProcesses, caplog: pytest.LogCaptureFixture
) -> None:
    telescope = viewer.Telescope(processes.url, api_key(processes.anna))
    credentials = telescope.view_credentials() | {"lifetime_s": 20}

    def receive(_topic: str, _payload: bytes) -> None:
        raise OverflowError("planted")

    with pytest.raises(OSError, match="the connection to the broker was lost"):
        viewer.watch(telescope, credentials, receive, threading.Event(), lambda: None)
    logged = [record for record in caplog.records if record.exc_info and "planted" in str(record.exc_info[1])]
    assert logged
    assert logged[0].levelname == "ERROR"


@pytest.mark.usefixtures("robot")
def test_a_connection_whose_credentials_expire_ends_without_an_error(processes: CloudProcesses) -> None:
    telescope = viewer.Telescope(processes.url, api_key(processes.anna))
    credentials = telescope.view_credentials() | {"lifetime_s": 2}
    connected = threading.Event()
    viewer.watch(telescope, credentials, lambda *_: None, threading.Event(), connected.set)
    assert connected.is_set()


@pytest.mark.parametrize("options", [[], ["--device"]], ids=["all", "one"])
def test_an_account_without_the_role_is_rejected_and_gets_no_endpoint(
    processes: CloudProcesses, robot: Robot, options: list[str], request: pytest.FixtureRequest
) -> None:
    stranger = processes.cloud.sign_in(f"stranger-{request.node.callspec.id}")
    options = [*options, robot.device] if options else []
    with start(processes, api_key(stranger), *options) as process:
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 4
    assert output == ""
    assert "ask" in errors
    assert "with the role viewer" in errors
    assert "Traceback" not in errors


def test_a_wrong_key_is_rejected(processes: CloudProcesses) -> None:
    with start(processes, "ts_nobody_x") as process:  # pragma: allowlist secret
        output, errors = process.communicate(timeout=60)
    assert (process.returncode, output) == (4, "")
    assert errors.startswith("foxglove: ")
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("key", "options", "message"),
    [
        ("", [], "TELESCOPE_KEY is empty"),
        ("ts_1_x", ["--ca", "missing.pem"], "--ca requires an https server"),  # pragma: allowlist secret
    ],
)
def test_wrong_options_are_named(processes: CloudProcesses, key: str, options: list[str], message: str) -> None:
    with start(processes, key, *options) as process:
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 2
    assert message in errors


def test_a_taken_port_is_named(processes: CloudProcesses, robot: Robot) -> None:
    port = processes.broker.port
    with start(processes, api_key(processes.anna), "--port", str(port), "--device", robot.device) as process:
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 3
    assert f"cannot listen on 127.0.0.1:{port}" in errors


@pytest.mark.usefixtures("robot")
def test_a_missing_library_is_an_error_with_the_command_that_installs_it(processes: CloudProcesses) -> None:
    code = "import sys; sys.modules['foxglove'] = None; from infra.foxglove.__main__ import main; sys.exit(main())"
    with start(processes, api_key(processes.anna), program=("-c", code)) as process:
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 3
    assert "foxglove is not installed; run `pip install 'telescope-server[foxglove]'`" in errors


@pytest.mark.usefixtures("robot")
def test_it_ends_with_sigterm(processes: CloudProcesses) -> None:
    with start(processes, api_key(processes.anna)) as process:
        ready(process)
        process.terminate()
        assert process.wait(60) == 0
