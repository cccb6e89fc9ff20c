"""One simulated robot: the wire contract of an agent, on a kinematic arm.

Rights, Stop, one action at a time and positions' ranges are decided by the agent's own code (``runtime.authority``,
``lease``, ``envelope``, ``pins``). What is missing, and why nothing of this may ever move metal: no control loop, no
limits of acceleration, no clearance, and no journal: what it has seen and whether it was stopped is gone with it.
"""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from device_agent.load_generator.kinematic_arm import DEVICE, Arm, Shape
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
from device_agent.protocol.security import signing
from device_agent.runtime.authority.authority import Authority, Reservation
from device_agent.runtime.authority.control_request import PendingControlRequest
from device_agent.runtime.authority.event_recorder import EventRecord, event_message
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.errors import Refused

WATCHDOG_S = 0.3
MAX_LOOP_AGE_S = 0.2
"""Equal to those of ``runtime.control.setpoint_stream``; a test checks this."""
STATE_EVERY_S = 30.0
STATE_GAP_S = 1.0
_FUTURE_MS = 2000
_REMEMBERED = 64
"""Number of commands whose acknowledgements are stored."""

Say = Callable[..., None]
"""``say(topic, payload, qos=…, retain=…)``."""


@dataclass(slots=True)
class _Run:
    """The running action."""

    command: str
    tenure: Reservation


class SwarmRobot:
    """One device of one agent. Not thread-safe: it runs in the event loop.

    Args:
        address: Space and agent.
        shape: What all arms have in common.
        pins: The cloud's keys.
        cloud_ms: The cloud's time [ms since 1970], or ``None`` while it is not known.
        say: Sends a message.
        now_s: Monotonic clock [s].

    Attributes:
        refused: Messages that were not obeyed.
    """

    def __init__(
        self,
        address: tuple[str, str],
        shape: Shape,
        *,
        pins: PinnedKeys,
        cloud_ms: Callable[[], float | None],
        say: Say,
        now_s: float,
    ) -> None:
        self.refused = 0
        self._address = (*address, DEVICE)
        self._shape = shape
        self._pins = pins
        self._cloud_ms = cloud_ms
        self._say = say
        self._now_s = now_s
        self._arm = Arm(shape, now_s)
        self._authority = Authority(LeaseGate(), None, hold=lambda _: self._arm.hold(), record=self._happened)
        self._handover = PendingControlRequest()
        self._answers: OrderedDict[str, tuple[int, bytes]] = OrderedDict()
        self._run: _Run | None = None
        self._setpoint: Setpoint | None = None
        self._setpoint_s = 0.0
        self._loop_age_ms = 0.0
        self._sequence = 0
        self._state_s = -STATE_EVERY_S
        self._shown: tuple[object, ...] = ()

    # ------------------------------------------------------------ outgoing

    def introduce(self, now_s: float) -> None:
        """Publish description and state, because the link is up."""
        kind = self._shape.kind
        self._retain(
            topics.DESC,
            Description(
                device=DEVICE,
                kind=kind.kind,
                robot_type=kind.type,
                label=kind.label,
                joints=kind.joints,
                capabilities=kind.capabilities,
                actions=("move_joints",),
                streams=kind.streams,
                watchdog_ms=round(WATCHDOG_S * 1000),
                max_loop_age_ms=round(MAX_LOOP_AGE_S * 1000),
                simulated=True,
                limits=("position", "velocity"),
                scripts_note="Simulated robots of a load test run no scripts.",
            ),
        )
        self._show(now_s, at_once=True)

    def lost(self) -> None:
        """Hold and end the lease, because the link is lost."""
        if self._run is not None or not self._arm.arrived:
            self._authority.end(Refused("link_lost", "the device lost its link"))

    def tick(self, now_s: float) -> None:
        """Advance the arm and publish telemetry."""
        self._catch_up(now_s)
        run = self._run
        if run is not None and self._arm.arrived:
            self._run = self._authority.reservation = None
            self._ack(run.command, AckStatus.DONE, progress=1.0, result={"position_rad": self._positions()})
        self._sequence += 1
        lease = self._authority.lease(now_s)
        followed = self._setpoint
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
            setpoint_sequence=followed.sequence if followed is not None else 0,
            setpoint_sent_ms=followed.sent_ms if followed is not None else 0.0,
            loop_age_ms=self._loop_age_ms,
        )
        self._say(topics.device(*self._address, topics.TELE, topics.JOINTS), codec.encode(telemetry), qos=0)
        self._show(now_s)

    def _show(self, now_s: float, *, at_once: bool = False) -> None:
        """Publish ``state`` on change, at most once per second, and every 30 s."""
        lease = self._authority.lease(now_s)
        asked = self._handover.current(lease, now_s)
        run = self._run.command if self._run is not None else ""
        shown = (self._mode(), self._authority.epochs, lease, asked, self._authority.latch, run)
        passed_s = now_s - self._state_s
        if not (at_once or passed_s >= STATE_EVERY_S or (passed_s >= STATE_GAP_S and shown != self._shown)):
            return
        self._state_s, self._shown = now_s, shown
        epoch, ended = self._authority.epochs
        leased = None
        if lease is not None:
            request = None
            if asked is not None:
                request = OpenRequest(
                    id=asked.id, requester=asked.requester, expires_in_ms=_left_ms(asked.expires_s, now_s)
                )
            leased = LeaseState(
                holder=lease.holder,
                epoch=lease.epoch,
                expires_in_ms=_left_ms(lease.expires_s, now_s),
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
            lease=leased,
            action=ActionState(id=run, kind="move_joints") if run else None,
        )
        self._retain(topics.STATE, state)

    def _retain(self, kind: str, message: object) -> None:
        payload = codec.encode(message, limit=codec.MAX_RETAINED_BYTES)
        self._say(topics.device(*self._address, kind), payload, qos=1, retain=True)

    def _happened(self, happened: EventRecord) -> None:
        self._say(topics.device(*self._address, topics.EVENT), codec.encode(event_message(DEVICE, happened)), qos=1)

    def _ack(self, command: str, status: AckStatus, **more: Any) -> None:
        sequence, _ = self._answers.get(command, (0, b""))
        ack = Ack(
            id=command, status=status, sequence=sequence + 1, at_ms=wall_ms(), tick_ms=_tick_ms(self._now_s), **more
        )
        payload = codec.encode(ack)
        self._answers[command] = (sequence + 1, payload)
        if len(self._answers) > _REMEMBERED:
            self._answers.popitem(last=False)
        self._say(topics.device(*self._address, topics.ACK), payload, qos=1)

    # ------------------------------------------------------------ incoming

    def receive(self, topic: str, payload: bytes, now_s: float) -> None:
        """Process one message; never raises."""
        self._catch_up(now_s)
        try:
            parsed = topics.parse(topic)
            if (parsed.space, parsed.agent, parsed.device) != self._address:
                self.refused += 1
            elif parsed.kind == topics.CMD:
                self._obey(payload)
            elif parsed.kind == topics.CTL:
                self._follow(parsed.name, codec.decode(payload, Setpoint))
            elif parsed.kind == topics.STOP:
                stop = codec.decode(payload, Stop)
                self._authority.stop(StopLatch(caller=stop.caller, reason=stop.reason, at_ms=wall_ms()))
        except (ProtocolError, SignatureError, Refused):
            self.refused += 1

    def _catch_up(self, now_s: float) -> None:
        self._now_s = now_s
        self._arm.advance(now_s)
        self._authority.expire(now_s)

    def _follow(self, epoch: str, setpoint: Setpoint) -> None:
        lease = self._authority.lease(self._now_s)
        if lease is None or setpoint.epoch != lease.epoch or epoch != str(lease.epoch):
            raise Refused("no_lease", "this lease is not in force here")
        before = self._setpoint
        if before is not None and before.epoch == setpoint.epoch and setpoint.sequence <= before.sequence:
            raise Refused("out_of_order", "a newer setpoint has arrived already")
        age_ms = _tick_ms(self._now_s) - setpoint.echo_tick_ms
        if not 0 <= age_ms <= MAX_LOOP_AGE_S * 1000:
            raise Refused("too_old", f"it answers telemetry of {age_ms} ms ago")
        self._authority.check_free()
        if self._run is not None:
            raise Refused("busy", "an action runs")
        if not isinstance(setpoint.target, JointTarget):
            raise Refused("unsupported", "a robot of a swarm moves its joints and nothing else")
        self._shape.envelope.check(setpoint.target.position_rad)
        target = list(self._arm.target_rad)
        self._shape.envelope.clamp(setpoint.target.position_rad, target)
        self._setpoint, self._loop_age_ms = setpoint, float(age_ms)
        self._arm.go(target, speed=self._shape.kind.streaming_speed, until_s=self._now_s + WATCHDOG_S)

    def _obey(self, payload: bytes) -> None:
        command = codec.decode(signing.verify(payload, self._pins), Command)
        if (command.space, command.agent, command.device) != self._address:
            raise Refused("wrong_address", "it is for another device")
        known = self._answers.get(command.id)
        if known is not None:
            self._say(topics.device(*self._address, topics.ACK), known[1], qos=1)
            return
        self._ack(command.id, AckStatus.RECEIVED)
        try:
            self._check_time(command)
            self._carry_out(command)
        except Refused as refused:
            self.refused += 1
            status = AckStatus.EXPIRED if refused.code == "expired" else AckStatus.FAILED
            self._ack(command.id, status, reason=Reason(code=refused.code, message=refused.message[:2000]))

    def _check_time(self, command: Command) -> None:
        if isinstance(command.request, StopDevice):
            return
        now_ms = self._cloud_ms()
        if now_ms is None:
            raise Refused("no_clock", "the device does not know the cloud's time yet; send it again")
        if now_ms > command.issued_at_ms + command.ttl_ms:
            raise Refused("expired", "it arrived after it had run out")
        if command.issued_at_ms > now_ms + _FUTURE_MS:
            raise Refused("from_the_future", "issued later than now")

    def _carry_out(self, command: Command) -> None:
        match command.request:
            case MoveJoints() as move:
                self._start(command, move)
                return
            case GrantLease(holder=holder, lease_ms=lease_ms, reason=reason):
                self._authority.grant(
                    epoch=command.epoch, holder=holder, lease_s=lease_ms / 1000, now_s=self._now_s, reason=reason
                )
            case ReleaseLease():
                self._authority.release(command.epoch)
            case RequestControl() as asked:
                lease = self._authority.lease(self._now_s)
                self._handover.open(asked, epoch=command.epoch, lease=lease, now_s=self._now_s)
            case WithdrawRequest(request=request):
                self._handover.withdraw(request)
            case StopDevice(reason=reason):
                self._authority.stop(StopLatch(caller=command.caller, reason=reason, at_ms=wall_ms()))
            case ResetStop():
                self._authority.fence(command.epoch)
                self._authority.reset_stop()
            case RotateKey(statements=statements):
                self._pins.follow(statements)
            case CancelAction(action=action):
                self._cancel(action, command.caller)
            case _:
                raise Refused("unsupported", "a robot of a swarm moves its joints and nothing else")
        self._ack(command.id, AckStatus.DONE)

    def _start(self, command: Command, move: MoveJoints) -> None:
        self._ack(command.id, AckStatus.ACCEPTED)
        self._authority.fence(command.epoch)
        self._authority.check_free()
        target = self._shape.envelope.resolve_target(move.position_rad, self._arm.position_rad)
        reservation = self._authority.reserve(command.epoch, self._taken_away)
        self._run = _Run(command.id, reservation)
        self._ack(command.id, AckStatus.STARTED)
        self._arm.go(target, speed=move.speed)

    def _cancel(self, action: str, who: str) -> None:
        if self._run is None or self._run.command != action:
            raise Refused("not_running", f"action {action} does not run on this device")
        self._run = self._authority.reservation = None
        self._arm.hold()
        self._ack(action, AckStatus.CANCELLED, reason=Reason(code="cancelled", message=f"cancelled by {who}"))

    def _taken_away(self, why: Refused) -> None:
        run, self._run = self._run, None
        if run is not None:
            self._ack(run.command, AckStatus.FAILED, reason=Reason(code=why.code, message=why.message))

    # ------------------------------------------------------------ condition

    def _positions(self) -> dict[str, float]:
        names = (joint.name for joint in self._shape.kind.joints)
        return dict(zip(names, self._arm.position_rad, strict=True))

    def _mode(self) -> Mode:
        if self._authority.latch is not None:
            return Mode.STOPPED
        if self._run is not None:
            return Mode.ACTION
        return Mode.IDLE if self._arm.arrived else Mode.STREAMING


def _tick_ms(now_s: float) -> int:
    return int(now_s * 1000)


def _left_ms(expires_s: float, now_s: float) -> int:
    return max(0, round((expires_s - now_s) * 1000))
