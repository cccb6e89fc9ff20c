"""What one device tells the world: acks, events, ``desc``, ``state``, telemetry, and the refusals it counts."""

import queue
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.sandbox import SandboxStatus
from device_agent.protocol import (
    Ack,
    AckStatus,
    ActionState,
    BaseLimits,
    Description,
    Fault,
    InterlockDescription,
    JointTelemetry,
    LeaseState,
    Measurements,
    Mode,
    OpenRequest,
    Restriction,
    State,
    StopLatch,
    Twin,
    camera_frames,
    codec,
    topics,
)
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.runtime.authority.control_request import Asked
from device_agent.runtime.authority.event_recorder import EventRecord, event_of
from device_agent.runtime.authority.lease_gate import Lease
from device_agent.runtime.control.base_motion import limits_of
from device_agent.runtime.control.setpoint_stream import MAX_LOOP_AGE_S, WATCHDOG_S
from device_agent.runtime.storage.journal import Journal
from device_agent.runtime.telemetry.outbox import Outbox, Publish

STATE_EVERY_S = 30.0
STATE_GAP_S = 1.0


@dataclass(frozen=True, slots=True)
class StateSnapshot:
    """What ``state`` shows; two that are equal need not be told twice."""

    mode: Mode
    epoch: int
    ended: int
    lease: Lease | None
    asked: Asked | None
    latch: StopLatch | None
    faults: tuple[Fault, ...]
    action: ActionState | None
    restrictions: tuple[Restriction, ...]
    stiffness: Mapping[str, float]

    def shown(self) -> tuple[object, ...]:
        """What makes a new ``state`` worth sending: progress alone does not."""
        return (
            self.mode,
            self.epoch,
            self.ended,
            self.lease,
            self.asked,
            self.latch,
            tuple((fault.code, fault.message) for fault in self.faults),
            self.action and self.action.id,
            self.restrictions,
            self.stiffness,
        )


class DevicePublisher:
    """Publishes for one device. Thread-safe but for ``introduce``, ``show`` and ``keep``, which are its office's.

    Args:
        address: Space, agent and name.
        label: Its name for people.
        robot_type: Joints, limits, streams.
        room_device: What it has where it is a device of a room.
        simulated: Whether no real metal moves.
        limits: What the agent itself holds, whoever moves it.
        actions: The kinds of action that it takes.
        interlocks: How the room slows or holds it.
        journal: Open.
        publish: Sends a message.
        outbox: Sends what must not be lost.

    Attributes:
        refusals: How often what was refused, by code.
        scripts: How movement scripts run here, as ``desc`` says it.
    """

    def __init__(
        self,
        *,
        address: tuple[str, str, str],
        label: str,
        robot_type: RobotType,
        room_device: RoomDeviceManifest | None = None,
        simulated: bool,
        limits: Sequence[str],
        actions: Sequence[str],
        interlocks: Sequence[InterlockDescription],
        journal: Journal,
        publish: Publish,
        outbox: Outbox,
    ) -> None:
        self._address = address
        self._name = address[2]
        self._label = label
        self._robot_type = robot_type
        self._room_device = room_device
        self._simulated = simulated
        self._limits = tuple(limits)
        self._actions = tuple(actions)
        self._interlocks = tuple(interlocks)
        self._journal = journal
        self._publish = publish
        self._outbox = outbox
        self._delivered: queue.SimpleQueue[Ack] = queue.SimpleQueue()
        self._believed_from_s = float("-inf")
        self._answer_again = False
        self._sequences: dict[str, int] = {}
        self._lock = threading.Lock()
        self._shown: tuple[object, ...] = ()
        self._shown_at_s = float("-inf")
        self.refusals: dict[str, int] = {}
        self.scripts = SandboxStatus("unavailable", "the agent has not looked yet what this machine has")

    # ------------------------------------------------------------ answers to commands

    def ack(self, command: str, status: AckStatus, **more: object) -> Ack:
        """The next ack of a command; not yet written or sent."""
        with self._lock:
            sequence = self._sequences.get(command, 0) + 1
            if status.terminal:
                self._sequences.pop(command, None)
            else:
                self._sequences[command] = sequence
        return Ack(id=command, status=status, sequence=sequence, at_ms=wall_ms(), tick_ms=tick_ms(), **more)  # type: ignore[arg-type]

    def report(self, command: str, status: AckStatus, **more: object) -> None:
        """Journal and publish the next ack of a command."""
        ack = self.ack(command, status, **more)
        self._journal.record(ack)
        self.send_ack(ack)

    def pass_by(self, command: str, status: AckStatus) -> None:
        """Publish the next ack of a command without journalling it: the one after it follows at once, and is."""
        self.send_ack(self.ack(command, status))

    def send_ack(self, ack: Ack) -> None:
        """Publish an ack that the journal has."""
        self._publish(self._topic(topics.ACK), codec.encode(ack), qos=1, delivered=partial(self._confirmed, ack))

    def _confirmed(self, ack: Ack) -> None:
        if time.monotonic() >= self._believed_from_s:
            self._delivered.put(ack)

    def keep(self) -> None:
        """Write down which answers have arrived."""
        while not self._delivered.empty():
            self._journal.delivered(self._delivered.get())

    # ------------------------------------------------------------ what the device is, and how

    def link_came(self) -> None:
        """Until the outbox begins to send, a confirmation does not say that the cloud has an answer: see ``Outbox``."""
        self._believed_from_s = time.monotonic() + self._outbox.settle_s
        self._answer_again = self._outbox.settle_s > 0

    def introduce(self, twin: Twin | None) -> None:
        """After each connection: what the device is, how it is, and the answers that may not have arrived."""
        self._retain(self._topic(topics.DESC), self._description())
        if twin is not None:
            self._retain(self._topic(topics.DESC, topics.TWIN), twin)
        self._shown_at_s = float("-inf")
        self._answer()

    def _answer(self) -> None:
        for ack in self._journal.undelivered(self._name):
            self.send_ack(ack)

    def show(self, now: StateSnapshot) -> None:
        """Publish ``state`` on change, at most once a second, and every 30 s."""
        now_s = time.monotonic()
        if self._answer_again and now_s >= self._believed_from_s:
            self._answer_again = False
            self._answer()
        shown = now.shown()
        age_s = now_s - self._shown_at_s
        if age_s < STATE_GAP_S or (shown == self._shown and age_s < STATE_EVERY_S):
            return
        at_ms = wall_ms()
        state = State(
            device=self._name,
            at_ms=at_ms,
            tick_ms=tick_ms(),
            mode=now.mode,
            epoch=now.epoch,
            ended_epoch=now.ended,
            stop=now.latch,
            lease=_lease_state(now.lease, now.asked, now_s),
            action=now.action,
            faults=now.faults,
            restrictions=now.restrictions,
            stiffness=dict(now.stiffness),
        )
        if self._retain(self._topic(topics.STATE), state):
            self._shown, self._shown_at_s = shown, now_s

    def tell(self, stream: str, telemetry: JointTelemetry | Measurements) -> None:
        """Publish a measurement; called by the control loop too, must not block."""
        payload = codec.encode(telemetry)
        sent = self._publish(self._topic(topics.TELE, stream), payload, qos=0)
        late = self._topic(topics.LATE, stream)
        self._outbox.measured(late, payload, at_ms=telemetry.at_ms, sent=sent, now_s=time.monotonic())

    def film(self, camera: str, frame: CameraFrame) -> None:
        """Publish a picture; one that cannot go out at once is let go."""
        self._publish(self._topic(topics.CAM, camera), camera_frames.encode(frame), qos=0)

    def event(self, happened: EventRecord) -> None:
        """Tell a fact that happened, as soon as it can be."""
        event = event_of(self._name, happened)
        self._outbox.happened(self._topic(topics.EVENT), codec.encode(event), at_ms=event.at_ms)

    def count(self, code: str) -> None:
        """Count a refusal."""
        self.refusals[code] = self.refusals.get(code, 0) + 1

    def _retain(self, topic: str, message: object) -> bool:
        return self._publish(topic, codec.encode(message, limit=codec.MAX_RETAINED_BYTES), qos=1, retain=True)

    def _description(self) -> Description:
        kind, fitted = self._robot_type, self._room_device
        return Description(
            device=self._name,
            kind=kind.kind,
            robot_type=kind.type,
            label=self._label,
            joints=kind.joints,
            mimic_joints=kind.mimic_joints,
            position_dependent_limits=kind.position_dependent_limits,
            frames=kind.frames,
            capabilities=kind.capabilities,
            actions=self._actions,
            postures=tuple(kind.postures),
            expressions=tuple(kind.expressions),
            behaviours=tuple(kind.behaviours),
            streams=kind.streams,
            cameras=kind.cameras if fitted is None else fitted.cameras,
            captures=() if fitted is None else fitted.captures,
            controls=() if fitted is None else fitted.controls,
            watchdog_ms=round(WATCHDOG_S * 1000),
            max_loop_age_ms=round(MAX_LOOP_AGE_S * 1000),
            simulated=self._simulated,
            limits=self._limits,
            interlocks=self._interlocks,
            diagnostics=() if fitted is None else fitted.diagnostics,
            # In the origin of the floor is what the manifest gives no place.
            position_m=fitted.position_m if fitted is not None and any(fitted.position_m) else None,
            base=None if kind.base is None else BaseLimits(**limits_of(kind.base)._asdict()),
            scripts=self.scripts.how,
            scripts_note=self.scripts.why[:2000],
        )

    def _topic(self, kind: str, name: str = "") -> str:
        return topics.device(*self._address, kind, name)


def _lease_state(lease: Lease | None, asked: Asked | None, now_s: float) -> LeaseState | None:
    if lease is None:
        return None
    request = None
    if asked is not None:
        request = OpenRequest(id=asked.id, requester=asked.by, expires_in_ms=_left_ms(asked.expires_s, now_s))
    return LeaseState(
        holder=lease.holder,
        epoch=lease.epoch,
        expires_in_ms=_left_ms(lease.expires_s, now_s),
        reason=lease.reason,
        request=request,
    )


def _left_ms(expires_s: float, now_s: float) -> int:
    return max(0, round((expires_s - now_s) * 1000))
