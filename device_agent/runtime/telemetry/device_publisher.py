"""Publishes the acks, events, description, state and telemetry of one device."""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.ports.sandbox import SandboxStatus
from device_agent.ports.skills import RobotBehaviour
from device_agent.ports.tracing import CommandTraces, NoTraces
from device_agent.protocol import (
    Ack,
    AckStatus,
    ActionState,
    BaseLimits,
    CameraConsent,
    Control,
    Description,
    Event,
    Fault,
    InterlockDescription,
    JointTelemetry,
    LeaseState,
    Measurements,
    Mode,
    OpenRequest,
    Reason,
    Restriction,
    State,
    StopLatch,
    Twin,
    camera_frames,
    codec,
    description,
    topics,
)
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.runtime.authority.control_request import ControlRequest
from device_agent.runtime.authority.event_recorder import EventRecord, event_message
from device_agent.runtime.authority.lease_gate import Lease
from device_agent.runtime.control.base_motion import limits_of
from device_agent.runtime.control.setpoint_stream import MAX_LOOP_AGE_S, WATCHDOG_S
from device_agent.runtime.storage.journal import Journal, JournalError
from device_agent.runtime.telemetry.outbox import FIRST_REPEAT_S, LAST_REPEAT_S, Outbox, Publish
from device_agent.runtime.telemetry.rate_meter import RateMeter

STATE_PERIOD_S = 30.0
STATE_MIN_GAP_S = 1.0
LOADED_STATE_PERIOD_S = 5.0
"""Period while the agent reduces work, for current rates [s]."""

_MAX_REPEATED = 50
"""Acks that are repeated at a time; the others follow after a second."""


@dataclass(frozen=True, slots=True)
class StateSnapshot:
    """Content of ``state``."""

    mode: Mode
    epoch: int
    ended: int
    lease: Lease | None
    control_request: ControlRequest | None
    latch: StopLatch | None
    faults: tuple[Fault, ...]
    action: ActionState | None
    restrictions: tuple[Restriction, ...]
    stiffness: Mapping[str, float]
    load: int = 0
    recording: bool = False
    recorded_cameras: tuple[str, ...] = ()
    camera_consent: CameraConsent | None = None

    def key(self) -> tuple[object, ...]:
        """The part whose change triggers a new ``state``; progress alone does not."""
        unchanged = (getattr(self, name) for name in self.__slots__ if name not in {"faults", "action"})
        return *unchanged, tuple((fault.code, fault.message) for fault in self.faults), self.action and self.action.id


class DevicePublisher:
    """Publisher of one device. Thread-safe.

    Only the command processor calls ``publish_description``, ``update_description``, ``publish_state``,
    ``repeat_acks`` and ``update_journal``.

    Attributes:
        rejections: Number of rejections by code.
        scripts: How movement scripts run here, for the description.
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
        robot_behaviours: Callable[[], tuple[RobotBehaviour, ...]] = tuple,
        controls: Sequence[Control] = (),
        interlocks: Sequence[InterlockDescription],
        streaming: bool,
        journal: Journal,
        publish: Publish,
        outbox: Outbox,
        traces: CommandTraces | None = None,
        record_event: Callable[[Event], None] | None = None,
    ) -> None:
        self._record_event = record_event
        self._address = address
        self._name = address[2]
        self._label = label
        self._robot_type = robot_type
        self._room_device = room_device
        self._simulated = simulated
        self._limits = tuple(limits)
        self._actions = tuple(actions)
        self._robot_behaviours = robot_behaviours
        self._controls = tuple(controls)
        self._described: tuple[RobotBehaviour, ...] | None = None
        self._interlocks = tuple(interlocks)
        self._streaming = streaming
        self._journal = journal
        self._publish = publish
        self._outbox = outbox
        self._traces = traces or NoTraces()
        self._unrecorded: deque[Ack] = deque()
        self._delivered: queue.SimpleQueue[Ack] = queue.SimpleQueue()
        self._ack_sent = threading.Event()
        self._repeat_s = float("inf")
        self._pause_s = FIRST_REPEAT_S
        self._repeated = 0
        self._sequences: dict[str, int] = {}
        self._lock = threading.Lock()
        self._rates = RateMeter()
        self._published_key: tuple[object, ...] = ()
        self._published_s = float("-inf")
        self.rejections: dict[str, int] = {}
        self.scripts = SandboxStatus("unavailable", "the agent has not checked this machine yet")

    # ------------------------------------------------------------ acks

    def create_ack(self, command: str, status: AckStatus, *, reason: Reason | None = None, **fields: object) -> Ack:
        """Create the next ack of a command; it is neither journalled nor sent yet."""
        with self._lock:
            sequence = self._sequences.get(command, 0) + 1
            if status.terminal:
                self._sequences.pop(command, None)
            else:
                self._sequences[command] = sequence
        fields = {"traceparent": self._traces.step(command, status, reason), **fields}
        return Ack(
            id=command,
            status=status,
            sequence=sequence,
            at_ms=wall_ms(),
            tick_ms=tick_ms(),
            reason=reason,
            **fields,  # type: ignore[arg-type]
        )

    def report(self, command: str, status: AckStatus, *, recorded: EventRecord | None = None, **fields: Any) -> None:
        """Journal and publish the next ack of a command. ``recorded``: an event for the recording of the session.

        A terminal ack is also published if it cannot be journalled: ``update_journal`` journals it later.

        Raises:
            JournalError: Another ack cannot be journalled; it is not published.
        """
        if recorded is not None and self._record_event is not None:
            self._record_event(event_message(self._name, recorded))
        ack = self.create_ack(command, status, **fields)
        try:
            self._journal.record(ack)
        except JournalError:
            if not ack.status.terminal:
                raise
            self._unrecorded.append(ack)
        self.send_ack(ack)
        if ack.status.terminal:
            self._traces.end(command)

    def send_ack(self, ack: Ack) -> None:
        """Publish an ack; ``repeat_acks`` repeats journalled acks until they are delivered."""
        self._transmit(ack)
        self._ack_sent.set()

    def _transmit(self, ack: Ack) -> None:
        self._publish(self._topic(topics.ACK), codec.encode(ack), qos=1, delivered=partial(self._delivered.put, ack))

    def repeat_acks(self) -> None:
        """Publish undelivered acks again: 1 s after a new one, then after twice the time, at most every 8 s."""
        now_s = time.monotonic()
        if self._ack_sent.is_set():
            self._ack_sent.clear()
            self._pause_s = FIRST_REPEAT_S
            self._repeat_s = min(self._repeat_s, now_s + FIRST_REPEAT_S)
        if now_s < self._repeat_s:
            return
        acks = self._journal.undelivered(self._name, after=self._repeated, limit=_MAX_REPEATED)
        for ack in acks.values():
            self._transmit(ack)
        if len(acks) == _MAX_REPEATED:
            self._repeated, self._repeat_s = max(acks), now_s + FIRST_REPEAT_S
        elif acks or self._repeated:
            self._repeated, self._repeat_s = 0, now_s + self._pause_s
            self._pause_s = min(2 * self._pause_s, LAST_REPEAT_S)
        else:
            self._repeat_s = float("inf")

    def update_journal(self) -> None:
        """Journal terminal acks that could not be journalled before, and which acks were delivered.

        Raises:
            JournalError: The next call continues.
        """
        while self._unrecorded:
            self._journal.record(self._unrecorded[0])
            self._unrecorded.popleft()
        while not self._delivered.empty():
            self._journal.delivered(self._delivered.get())

    # ------------------------------------------------------------ description and state

    def publish_description(self, twin: Twin | None) -> None:
        """Publish the description, and make the next state and undelivered acks due: the link is up."""
        self._publish_description()
        if twin is not None:
            self._retain(self._topic(topics.DESC, topics.TWIN), twin)
        self._published_s = float("-inf")
        self._repeated, self._repeat_s, self._pause_s = 0, float("-inf"), FIRST_REPEAT_S

    def update_description(self) -> None:
        """Publish the description again if the robot's behaviours have changed since it was published."""
        if self._described is not None and self._described != self._robot_behaviours():
            self._publish_description()

    def _publish_description(self) -> None:
        self._described = self._robot_behaviours()
        self._retain(self._topic(topics.DESC), self._description())

    def publish_state(self, snapshot: StateSnapshot, *, urgent: bool = False) -> None:
        """Publish ``state`` on change, at most once a second unless it is urgent, and every 30 s."""
        now_s = time.monotonic()
        key = snapshot.key()
        age_s = now_s - self._published_s
        period_s = LOADED_STATE_PERIOD_S if snapshot.load else STATE_PERIOD_S
        if (age_s < STATE_MIN_GAP_S and not urgent) or (key == self._published_key and age_s < period_s):
            return
        at_ms = wall_ms()
        state = State(
            device=self._name,
            at_ms=at_ms,
            tick_ms=tick_ms(),
            mode=snapshot.mode,
            epoch=snapshot.epoch,
            ended_epoch=snapshot.ended,
            stop=snapshot.latch,
            lease=_lease_state(snapshot.lease, snapshot.control_request, now_s),
            action=snapshot.action,
            faults=snapshot.faults,
            restrictions=snapshot.restrictions,
            stiffness=dict(snapshot.stiffness),
            load=snapshot.load,
            recording=snapshot.recording,
            recorded_cameras=snapshot.recorded_cameras,
            camera_consent=snapshot.camera_consent,
            rates_hz=dict(self._rates.rates_hz(now_s)),
        )
        if self._retain(self._topic(topics.STATE), state):
            self._published_key, self._published_s = key, now_s

    def publish_telemetry(self, stream: str, telemetry: JointTelemetry | Measurements) -> None:
        """Publish a measurement; never blocks, because the control loop calls it."""
        payload = codec.encode(telemetry)
        now_s = time.monotonic()
        self._rates.record(f"{topics.TELE}/{stream}", now_s)
        sent = self._publish(self._topic(topics.TELE, stream), payload, qos=0)
        late = self._topic(topics.LATE, stream)
        self._outbox.add_measurement(late, payload, at_ms=telemetry.at_ms, sent=sent, now_s=now_s)

    def publish_frame(self, camera: str, frame: CameraFrame) -> None:
        """Publish a camera frame; it is dropped if it cannot be sent immediately."""
        self._rates.record(f"{topics.CAM}/{camera}", time.monotonic())
        self._publish(self._topic(topics.CAM, camera), camera_frames.encode(frame), qos=0)

    def publish_event(self, event: EventRecord) -> None:
        """Publish an event through the outbox."""
        message = event_message(self._name, event)
        if self._record_event is not None:
            self._record_event(message)
        self._outbox.add_event(self._topic(topics.EVENT), codec.encode(message), at_ms=message.at_ms)

    def count_rejection(self, code: str) -> None:
        """Count a rejection."""
        self.rejections[code] = self.rejections.get(code, 0) + 1

    def _retain(self, topic: str, message: object) -> bool:
        return self._publish(topic, codec.encode(message, limit=codec.MAX_RETAINED_BYTES), qos=1, retain=True)

    def _description(self) -> Description:
        own = self._described or ()
        robot_type, room = self._robot_type, self._room_device
        return Description(
            device=self._name,
            kind=robot_type.kind,
            robot_type=robot_type.type,
            label=self._label,
            joints=robot_type.joints,
            mimic_joints=robot_type.mimic_joints,
            position_dependent_limits=robot_type.position_dependent_limits,
            frames=robot_type.frames,
            capabilities=robot_type.capabilities,
            actions=self._actions,
            postures=tuple(robot_type.postures),
            expressions=tuple(robot_type.expressions),
            behaviours=(*robot_type.behaviours, *(each.name for each in own)),
            robot_behaviours=tuple(
                description.RobotBehaviour(name=each.name, label=each.title, recovery=each.recovery) for each in own
            ),
            streams=robot_type.streams,
            cameras=robot_type.cameras if room is None else room.cameras,
            captures=() if room is None else room.captures,
            controls=self._controls if room is None else room.controls,
            watchdog_ms=round(WATCHDOG_S * 1000),
            max_loop_age_ms=round(MAX_LOOP_AGE_S * 1000),
            simulated=self._simulated,
            limits=self._limits,
            interlocks=self._interlocks,
            diagnostics=() if room is None else room.diagnostics,
            # A manifest without a position leaves the origin.
            position_m=room.position_m if room is not None and any(room.position_m) else None,
            base=None if robot_type.base is None else BaseLimits(**limits_of(robot_type.base)._asdict()),
            streaming=self._streaming,
            scripts=self.scripts.mode,
            scripts_note=self.scripts.reason[:2000],
        )

    def _topic(self, kind: str, name: str = "") -> str:
        return topics.device(*self._address, kind, name)


def _lease_state(lease: Lease | None, control_request: ControlRequest | None, now_s: float) -> LeaseState | None:
    if lease is None:
        return None
    request = None
    if control_request is not None:
        request = OpenRequest(
            id=control_request.id,
            requester=control_request.requester,
            expires_in_ms=_remaining_ms(control_request.expires_s, now_s),
        )
    return LeaseState(
        holder=lease.holder,
        epoch=lease.epoch,
        expires_in_ms=_remaining_ms(lease.expires_s, now_s),
        reason=lease.reason,
        request=request,
    )


def _remaining_ms(expires_s: float, now_s: float) -> int:
    return max(0, round((expires_s - now_s) * 1000))
