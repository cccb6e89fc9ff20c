"""One simulated robot: the wire contract of an agent, on a kinematic arm.

The code of the real agent decides on leases, Stop, reservations and position ranges (``runtime.authority``,
``runtime.commands.pinned_keys``, ``runtime.control.limits``). This class must never control a real robot: it has no
control loop, no acceleration limits, no collision checks and no journal.
"""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from device_agent.load_generator.kinematic_arm import DEVICE, Arm, ArmType
from device_agent.ports.clock import wall_ms
from device_agent.protocol import (
    Ack,
    AckStatus,
    ActionState,
    CancelAction,
    Command,
    Description,
    GrantLease,
    JointTarget,
    JointTelemetry,
    LeaseState,
    Mode,
    MoveJoints,
    OpenRequest,
    Reason,
    ReleaseLease,
    RequestControl,
    ResetStop,
    RotateKey,
    Setpoint,
    State,
    Stop,
    StopDevice,
    StopLatch,
    WithdrawRequest,
    codec,
    topics,
)
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.fields import printable
from device_agent.protocol.security import setpoints, signing
from device_agent.protocol.state import unverified
from device_agent.runtime.authority.authority import Authority, Reservation
from device_agent.runtime.authority.control_request import PendingControlRequest
from device_agent.runtime.authority.event_recorder import EventRecord, event_message
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.errors import Refused

WATCHDOG_S = 0.3
MAX_LOOP_AGE_S = 0.2
"""A test checks that both equal those of ``runtime.control.setpoint_stream``."""
STATE_PERIOD_S = 30.0
STATE_MIN_GAP_S = 1.0
_FUTURE_MS = 2000
_MAX_STORED_ACKS = 64
"""Number of commands whose acknowledgements are stored."""

Publish = Callable[..., None]
"""``publish(topic, payload, qos=…, retain=…)``."""


@dataclass(slots=True)
class _Run:
    """The running action."""

    command: str
    reservation: Reservation


class SimulatedRobot:
    """One device of one agent. Not thread-safe: it runs in the event loop.

    Args:
        address: Space and agent.
        arm_type: Properties that all arms share.
        keys: Pinned keys of the cloud.
        cloud_ms: The cloud's time [ms since 1970], or ``None`` while it is unknown.
        publish: Sends a message.
        now_s: Monotonic clock [s].

    Attributes:
        refused: Number of rejected messages.
    """

    def __init__(
        self,
        address: tuple[str, str],
        arm_type: ArmType,
        *,
        keys: PinnedKeys,
        cloud_ms: Callable[[], float | None],
        publish: Publish,
        now_s: float,
    ) -> None:
        self.refused = 0
        self._address = (*address, DEVICE)
        self._arm_type = arm_type
        self._keys = keys
        self._cloud_ms = cloud_ms
        self._publish = publish
        self._now_s = now_s
        self._arm = Arm(arm_type, now_s)
        self._authority = Authority(LeaseGate(), None, hold=lambda _: self._arm.hold(), record=self._publish_event)
        self._control_request = PendingControlRequest()
        self._acks: OrderedDict[str, tuple[int, bytes]] = OrderedDict()
        self._run: _Run | None = None
        self._setpoint: Setpoint | None = None
        self._setpoint_s = 0.0
        self._loop_age_ms = 0.0
        self._sequence = 0
        self._state_s = -STATE_PERIOD_S
        self._published_key: tuple[object, ...] = ()

    # ------------------------------------------------------------ outgoing

    def on_connected(self, now_s: float) -> None:
        """Publish description and state."""
        robot_type = self._arm_type.robot_type
        self._retain(
            topics.DESC,
            Description(
                device=DEVICE,
                kind=robot_type.kind,
                robot_type=robot_type.type,
                label=robot_type.label,
                joints=robot_type.joints,
                capabilities=robot_type.capabilities,
                actions=("move_joints",),
                streams=robot_type.streams,
                watchdog_ms=round(WATCHDOG_S * 1000),
                max_loop_age_ms=round(MAX_LOOP_AGE_S * 1000),
                simulated=True,
                limits=("position", "velocity"),
                scripts_note="Simulated robots of a load test run no scripts.",
            ),
        )
        self._publish_state(now_s, force=True)

    def on_disconnected(self) -> None:
        """End the lease of a moving arm, and hold."""
        if self._run is not None or not self._arm.arrived:
            self._authority.end(Refused("link_lost", "the device lost its link"))

    def tick(self, now_s: float) -> None:
        """Advance the arm and publish telemetry."""
        self._update(now_s)
        run = self._run
        if run is not None and self._arm.arrived:
            self._run = self._authority.reservation = None
            self._ack(run.command, AckStatus.DONE, progress=1.0, result={"position_rad": self._positions()})
        self._sequence += 1
        lease = self._authority.lease(now_s)
        setpoint = self._setpoint
        telemetry = JointTelemetry(
            tick_ms=_tick_ms(now_s),
            at_ms=wall_ms(),
            sequence=self._sequence,
            mode=self._mode(),
            position_rad=tuple(self._arm.position_rad),
            velocity_rad_s=tuple(self._arm.velocity_rad_s),
            effort_nm=(0.0,) * len(self._arm.position_rad),
            commanded_rad=tuple(self._arm.position_rad),
            epoch=lease.epoch if lease is not None else 0,
            setpoint_sequence=setpoint.sequence if setpoint is not None else 0,
            setpoint_sent_ms=setpoint.sent_ms if setpoint is not None else 0.0,
            loop_age_ms=self._loop_age_ms,
        )
        self._publish(topics.device(*self._address, topics.TELE, topics.JOINTS), codec.encode(telemetry), qos=0)
        self._publish_state(now_s)

    def _publish_state(self, now_s: float, *, force: bool = False) -> None:
        """Publish ``state`` on change, at most once per second, and every 30 s."""
        lease = self._authority.lease(now_s)
        pending = self._control_request.current(lease, now_s)
        run = self._run.command if self._run is not None else ""
        key = (self._mode(), self._authority.epochs, lease, pending, self._authority.latch, run)
        age_s = now_s - self._state_s
        if not (force or age_s >= STATE_PERIOD_S or (age_s >= STATE_MIN_GAP_S and key != self._published_key)):
            return
        self._state_s, self._published_key = now_s, key
        epoch, ended = self._authority.epochs
        lease_state = None
        if lease is not None:
            request = None
            if pending is not None:
                request = OpenRequest(
                    id=pending.id, requester=pending.requester, expires_in_ms=_remaining_ms(pending.expires_s, now_s)
                )
            lease_state = LeaseState(
                holder=lease.holder,
                epoch=lease.epoch,
                expires_in_ms=_remaining_ms(lease.expires_s, now_s),
                reason=lease.reason,
                request=request,
            )
        state = State(
            device=DEVICE,
            at_ms=wall_ms(),
            tick_ms=_tick_ms(now_s),
            mode=self._mode(),
            epoch=epoch,
            ended_epoch=ended,
            stop=self._authority.latch,
            lease=lease_state,
            action=ActionState(id=run, kind="move_joints") if run else None,
        )
        self._retain(topics.STATE, state)

    def _retain(self, kind: str, message: object) -> None:
        payload = codec.encode(message, limit=codec.MAX_RETAINED_BYTES)
        self._publish(topics.device(*self._address, kind), payload, qos=1, retain=True)

    def _publish_event(self, event: EventRecord) -> None:
        self._publish(topics.device(*self._address, topics.EVENT), codec.encode(event_message(DEVICE, event)), qos=1)

    def _ack(self, command: str, status: AckStatus, **fields: Any) -> None:
        sequence, _ = self._acks.get(command, (0, b""))
        ack = Ack(
            id=command, status=status, sequence=sequence + 1, at_ms=wall_ms(), tick_ms=_tick_ms(self._now_s), **fields
        )
        payload = codec.encode(ack)
        self._acks[command] = (sequence + 1, payload)
        if len(self._acks) > _MAX_STORED_ACKS:
            self._acks.popitem(last=False)
        self._publish(topics.device(*self._address, topics.ACK), payload, qos=1)

    # ------------------------------------------------------------ incoming

    def receive(self, topic: str, payload: bytes, now_s: float) -> None:
        """Process one message; never raises."""
        self._update(now_s)
        try:
            parsed = topics.parse(topic)
            if (parsed.space, parsed.agent, parsed.device) != self._address:
                self.refused += 1
            elif parsed.kind == topics.CMD:
                self._process(payload)
            elif parsed.kind == topics.CTL:
                self._accept_setpoint(parsed.name, payload)
            elif parsed.kind == topics.STOP:
                stop = codec.decode(payload, Stop)
                reason = printable(stop.reason[:2000])
                latch = StopLatch(caller=unverified(parsed.name), reason=reason, at_ms=wall_ms())
                self._authority.stop(latch, message=stop.id)
        except (ProtocolError, SignatureError, Refused):
            self.refused += 1

    def _update(self, now_s: float) -> None:
        self._now_s = now_s
        self._arm.advance(now_s)
        self._authority.expire(now_s)

    def _accept_setpoint(self, epoch: str, payload: bytes) -> None:
        lease = self._authority.lease(self._now_s)
        if lease is None or epoch != str(lease.epoch):
            raise Refused("no_lease", "this lease is not in force")
        setpoint = codec.decode(setpoints.open_sealed(payload, lease.keys), Setpoint)
        if setpoint.epoch != lease.epoch:
            raise Refused("no_lease", "the epochs in the topic and in the message differ")
        previous = self._setpoint
        if previous is not None and previous.epoch == setpoint.epoch and setpoint.sequence <= previous.sequence:
            raise Refused("out_of_order", "a newer setpoint has already arrived")
        age_ms = _tick_ms(self._now_s) - setpoint.echo_tick_ms
        if not 0 <= age_ms <= MAX_LOOP_AGE_S * 1000:
            raise Refused("too_old", f"it echoes telemetry of {age_ms} ms ago")
        self._authority.check_free()
        if self._run is not None:
            raise Refused("busy", "an action runs")
        if not isinstance(setpoint.target, JointTarget):
            raise Refused("unsupported", "a simulated robot of a load test only moves its joints")
        self._arm_type.limits.check(setpoint.target.position_rad)
        target = list(self._arm.target_rad)
        self._arm_type.limits.clamp(setpoint.target.position_rad, target)
        self._setpoint, self._loop_age_ms = setpoint, float(age_ms)
        self._arm.move(target, speed=self._arm_type.robot_type.streaming_speed, until_s=self._now_s + WATCHDOG_S)

    def _process(self, payload: bytes) -> None:
        command = codec.decode(signing.verify(payload, self._keys), Command)
        if (command.space, command.agent, command.device) != self._address:
            raise Refused("wrong_address", "it is addressed to another device")
        stored = self._acks.get(command.id)
        if stored is not None:
            self._publish(topics.device(*self._address, topics.ACK), stored[1], qos=1)
            return
        self._ack(command.id, AckStatus.RECEIVED)
        try:
            self._check_time(command)
            self._apply(command)
        except Refused as refused:
            self.refused += 1
            status = AckStatus.EXPIRED if refused.code == "expired" else AckStatus.FAILED
            self._ack(command.id, status, reason=Reason(code=refused.code, message=refused.message[:2000]))

    def _check_time(self, command: Command) -> None:
        if isinstance(command.request, StopDevice):
            return
        now_ms = self._cloud_ms()
        if now_ms is None:
            raise Refused("no_clock", "the device does not know the cloud's time yet; retry")
        if now_ms > command.issued_at_ms + command.ttl_ms:
            raise Refused("expired", "it arrived after it had expired")
        if command.issued_at_ms > now_ms + _FUTURE_MS:
            raise Refused("from_the_future", "issued later than now")

    def _apply(self, command: Command) -> None:
        match command.request:
            case MoveJoints() as move:
                self._start(command, move)
                return
            case GrantLease(holder=holder, lease_ms=lease_ms, reason=reason, pairing=pairing):
                topic = topics.device(*self._address, topics.CTL, str(command.epoch))
                self._authority.grant(
                    epoch=command.epoch,
                    holder=holder,
                    lease_s=lease_ms / 1000,
                    now_s=self._now_s,
                    reason=printable(reason),
                    keys=self._keys.setpoint_keys(topic, pairing),
                )
            case ReleaseLease():
                self._authority.release(command.epoch)
            case RequestControl() as request:
                lease = self._authority.lease(self._now_s)
                self._control_request.open(request, epoch=command.epoch, lease=lease, now_s=self._now_s)
            case WithdrawRequest(request=request_id):
                self._control_request.withdraw(request_id)
            case StopDevice(reason=reason):
                latch = StopLatch(caller=command.caller, reason=printable(reason), at_ms=wall_ms(), verified=True)
                self._authority.stop(latch, message=command.id)
            case ResetStop():
                self._authority.fence(command.epoch)
                self._authority.reset_stop()
            case RotateKey(statements=statements):
                self._keys.follow(statements)
            case CancelAction(action=action):
                self._cancel(action, command.caller)
            case _:
                raise Refused("unsupported", "a simulated robot of a load test only moves its joints")
        self._ack(command.id, AckStatus.DONE)

    def _start(self, command: Command, move: MoveJoints) -> None:
        self._ack(command.id, AckStatus.ACCEPTED)
        self._authority.fence(command.epoch)
        self._authority.check_free()
        target = self._arm_type.limits.resolve_target(move.position_rad, self._arm.position_rad)
        reservation = self._authority.reserve(command.epoch, self._on_revoked)
        self._run = _Run(command.id, reservation)
        self._ack(command.id, AckStatus.STARTED)
        self._arm.move(target, speed=move.speed)

    def _cancel(self, action: str, caller: str) -> None:
        if self._run is None or self._run.command != action:
            raise Refused("not_running", f"action {action} does not run on this device")
        self._run = self._authority.reservation = None
        self._arm.hold()
        self._ack(action, AckStatus.CANCELLED, reason=Reason(code="cancelled", message=f"cancelled by {caller}"))

    def _on_revoked(self, reason: Refused) -> None:
        run, self._run = self._run, None
        if run is not None:
            self._ack(run.command, AckStatus.FAILED, reason=Reason(code=reason.code, message=reason.message))

    # ------------------------------------------------------------ state

    def _positions(self) -> dict[str, float]:
        names = (joint.name for joint in self._arm_type.robot_type.joints)
        return dict(zip(names, self._arm.position_rad, strict=True))

    def _mode(self) -> Mode:
        if self._authority.latch is not None:
            return Mode.STOPPED
        if self._run is not None:
            return Mode.ACTION
        return Mode.IDLE if self._arm.arrived else Mode.STREAMING


def _tick_ms(now_s: float) -> int:
    return int(now_s * 1000)


def _remaining_ms(expires_s: float, now_s: float) -> int:
    return max(0, round((expires_s - now_s) * 1000))
