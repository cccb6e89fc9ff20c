"""A whole device with a fake driver and broker: commands in, acks out."""

import hashlib
import time
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.ports.geometry import RobotGeometry
from device_agent.ports.sandbox import Sandbox
from device_agent.ports.speech import Speech
from device_agent.ports.tracing import CommandTraces
from device_agent.ports.uploads import Uploads
from device_agent.protocol import (
    SHIPPED,
    Ack,
    AckStatus,
    Command,
    Event,
    JointTarget,
    JointTelemetry,
    Reason,
    RunMovement,
    Setpoint,
    State,
    Stop,
    codec,
    topics,
)
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.manifests.tasks import Tasks
from device_agent.protocol.security import setpoints, signing
from device_agent.runtime.actions.task_monitors import TaskMonitors
from device_agent.runtime.device import Device
from device_agent.runtime.load import LoadGovernor
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.recording.recorder import Recorder
from device_agent.runtime.storage.journal import Journal
from device_agent.runtime.storage.outbox_store import OutboxStore
from device_agent.runtime.supervision import Supervisor
from device_agent.runtime.telemetry.outbox import Outbox
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.pinned_keys import IDENTITY, pinned_keys_of
from tests.harness.agent.sandbox import warm_sandbox

WITHIN_S = 120.0
OWNER = "accountaaaaaaaaa"


class DeviceHarness:
    """A device, the cloud's key, and all messages of the device."""

    def __init__(
        self,
        folder: Path,
        *,
        interlocks: Sequence[InterlockRule] = (),
        driver: FakeDriver | None = None,
        kind: RobotType | None = None,
        geometry: RobotGeometry | None = None,
        sandbox: Sandbox | None = None,
        speech: Speech | None = None,
        uploads: Uploads | None = None,
        supervisor: Supervisor | None = None,
        traces: CommandTraces | None = None,
        recorder: Recorder | None = None,
        tasks: Tasks | None = None,
        room: Sequence[tuple[str, str]] = (),
    ) -> None:
        self.load = LoadGovernor()
        self.key = signing.generate()
        self.kind = kind or robot_type()
        self.messages: list[tuple[str, bytes]] = []
        self.driver = driver or FakeDriver()
        self.journal = Journal(folder / "journal.db")
        self.journal.open(now_ms=wall_ms())
        self.journal.end_open(now_ms=wall_ms(), tick_ms=tick_ms())
        self.clock = CloudClock()
        self.clock.observe(server_ms=wall_ms(), sent_tick_ms=tick_ms(), received_tick_ms=tick_ms())
        self.number = 0
        store = OutboxStore(folder / "outbox.db", own="ts/v1/s/a/", max_bytes=10**6, max_age_ms=3_600_000)
        self.outbox = Outbox(store, publish=self.publish, device_topic="ts/v1/s/a/arm")
        self.outbox.link_changed(True)
        self.outbox.start()
        self.readings = ReadingCache(
            space="s", agent="a", own=["arm"], named=[*((rule.device, rule.stream) for rule in interlocks), *room]
        )
        self.device = Device(
            name="arm",
            label="Arm",
            space="s",
            agent="a",
            robot_type=self.kind,
            driver=self.driver,
            journal=self.journal,
            cloud_clock=self.clock,
            keys=pinned_keys_of(self.key),
            publish=self.publish,
            outbox=self.outbox,
            readings=self.readings,
            interlocks=interlocks,
            geometry=geometry,
            sandbox=sandbox or warm_sandbox(),
            owner=OWNER,
            speech=speech,
            uploads=uploads,
            load=self.load,
            supervisor=supervisor,
            traces=traces,
            recorder=recorder,
            task_monitors=TaskMonitors(tasks, self.driver, self.readings),
        )

    def start(self) -> None:
        self.device.start()
        self.device.link_changed(True)

    def stop(self) -> None:
        self.device.stop()
        self.outbox.stop()
        self.journal.close()

    def publish(
        self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Callable[[], None] | None = None
    ) -> bool:
        assert qos in {0, 1}
        assert retain == (topics.parse(topic).kind in {topics.DESC, topics.STATE})
        self.messages.append((topic, payload))
        if delivered is not None:
            delivered()
        return True

    def command(self, request: Any, *, epoch: int = 0, command_id: str | None = None, **changes: Any) -> str:
        self.number += 1
        fields: dict[str, Any] = {
            "id": command_id or f"c{self.number}-{uuid.uuid4().hex[:8]}",
            "space": "s",
            "agent": "a",
            "device": "arm",
            "issued_at_ms": wall_ms(),
            "ttl_ms": 10_000,
            "caller": "ann",
            "epoch": epoch,
            "request": request,
        }
        command = Command(**(fields | changes))
        self.receive(topics.CMD, signing.sign(codec.encode(command), self.key))
        return command.id

    def script(self, source: str, version: int = 1, author: str = SHIPPED) -> RunMovement:
        return signed_movement(source, self.key, version=version, author=author, robot_type=self.kind.type)

    def receive(self, kind: str, payload: bytes, name: str = "") -> None:
        self.device.receive(topics.Topic("s", "a", "arm", kind, name), payload)

    def setpoint(self, epoch: int, sequence: int, elbow: float = 2.0) -> None:
        """Receive a setpoint of the lease's holder."""
        self.receive(topics.CTL, self.sealed(epoch, sequence, elbow), str(epoch))

    def sealed(
        self, epoch: int, sequence: int, elbow: float = 2.0, *, number: int = 0, key: Ed25519PrivateKey | None = None
    ) -> bytes:
        """A setpoint of input ``number``, sealed with the key of a lease that the cloud with this ``key`` granted."""
        target = JointTarget(position_rad={"elbow": elbow})
        setpoint = Setpoint(
            epoch=epoch, sequence=sequence, echo_tick_ms=tick_ms(), sent_ms=0.5, target=target, input=number
        )
        topic = topics.device("s", "a", "arm", topics.CTL, str(epoch))
        lease_key = setpoints.lease_key(key or self.key, IDENTITY.public_key(), topic=topic, pairing="")
        return setpoints.seal(codec.encode(setpoint), lease_key, topic)

    def published(self, kind: str, message: type[Any], name: str = "") -> list[Any]:
        expected = topics.device("s", "a", "arm", kind, name)
        return [codec.decode(payload, message) for topic, payload in list(self.messages) if topic == expected]

    def acks(self, command: str) -> list[Ack]:
        return [ack for ack in self.published(topics.ACK, Ack) if ack.id == command]

    def end(self, command: str) -> Ack:
        ended: Ack = eventually(lambda: next((ack for ack in self.acks(command) if ack.status.terminal), None))
        return ended

    def end_code(self, command: str) -> str:
        """The code with which a command was rejected."""
        reason = self.end(command).reason
        assert reason is not None
        return reason.code

    def done(self, request: Any, **fields: Any) -> Ack:
        """Send a command, which must succeed; returns its last ack."""
        ack = self.end(self.command(request, **fields))
        assert ack.status is AckStatus.DONE, ack.reason
        return ack

    def failed(self, request: Any, **fields: Any) -> Reason:
        """Send a command, which must fail; returns the reason."""
        ack = self.end(self.command(request, **fields))
        assert ack.status is AckStatus.FAILED
        assert ack.reason is not None
        return ack.reason

    def running(self, request: Any, **fields: Any) -> str:
        """Send a command; returns its id when it has started."""
        command = self.command(request, **fields)
        eventually(lambda: any(ack.status is AckStatus.STARTED for ack in self.acks(command)))
        return command

    def receive_stop(self) -> None:
        """Receive a Stop message of the account ``bob``."""
        self.receive(topics.STOP, codec.encode(Stop(id="s1", reason="smoke")), "bob")

    def events(self, kind: str) -> list[Event]:
        return [event for event in self.published(topics.EVENT, Event) if event.kind == kind]

    def telemetry(self) -> JointTelemetry:
        newest: JointTelemetry = eventually(lambda: self.published(topics.TELE, JointTelemetry, "joints")[-1:])[0]
        return newest


def signed_movement(
    source: str, key: Ed25519PrivateKey, *, version: int = 1, author: str = SHIPPED, robot_type: str = "test"
) -> RunMovement:
    """A command to run this movement, signed as by the cloud."""
    digest = hashlib.sha256(source.encode()).hexdigest()
    text = signing.movement_text(robot_type, "dance", version, digest)
    return RunMovement(
        robot_type=robot_type,
        name="dance",
        version=version,
        sha256=digest,
        source=source,
        author=author,
        key=signing.key_id(key.public_key()),
        signature=signing.sign_text(text, key, context=signing.MOVEMENT_CONTEXT),
    )


def eventually(probe: Callable[[], Any]) -> Any:
    deadline_s = time.monotonic() + WITHIN_S
    while time.monotonic() < deadline_s:
        if found := probe():
            return found
        time.sleep(0.01)
    pytest.fail(f"the condition did not hold within {WITHIN_S} s")


def wait_for_state(harness: DeviceHarness, expected: Callable[[State], Any]) -> State:
    found: State = eventually(lambda: [s for s in harness.published(topics.STATE, State)[-1:] if expected(s)])[0]
    return found
