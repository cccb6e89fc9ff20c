"""One device at work: it takes commands one by one, writes the journal, and publishes acks and ``state``.

Two threads a device: the control loop (``loop``), which never waits for disk or network, and this one, the *office*.
Setpoints and Stop go from the transport's thread straight into the controller.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.ports.driver import Driver
from device_agent.protocol import codec, signing, topics
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.messages import (
    Ack,
    AckStatus,
    CancelAction,
    Command,
    Description,
    Fault,
    GrantLease,
    JointTelemetry,
    LeaseState,
    MoveJoints,
    Reason,
    ReleaseLease,
    ResetStop,
    RunMovement,
    Setpoint,
    State,
    Stop,
    StopDevice,
    StopLatch,
    Twin,
)
from device_agent.protocol.robot_type import RobotType
from device_agent.runtime.actions import Executor
from device_agent.runtime.controller import MAX_LOOP_AGE_S, WATCHDOG_S, Controller
from device_agent.runtime.journal import Journal
from device_agent.runtime.lease import Lease, LeaseGate, Refused
from device_agent.runtime.loop import ControlLoop

Publish = Callable[..., bool]
"""``Transport.publish``."""

STATE_EVERY_S = 30.0
STATE_GAP_S = 1.0
_FUTURE_MS = 2000
"""A command may seem issued this much later than now: more than the error of the clock estimate ever is."""
_log = logging.getLogger(__name__)


class Device:
    """One device of an agent.

    Args:
        name: Its name at the agent, a level of its topics.
        label: Its name for people.
        space: Id of the space.
        agent: Id of the agent.
        robot_type: Joints, limits, period.
        driver: Not yet connected.
        journal: Open.
        cloud_clock: For ``ttl_ms``.
        keys: The cloud's pinned public keys by key id.
        publish: Sends a message.
    """

    def __init__(
        self,
        *,
        name: str,
        label: str,
        space: str,
        agent: str,
        robot_type: RobotType,
        driver: Driver,
        journal: Journal,
        cloud_clock: CloudClock,
        keys: Mapping[str, Ed25519PublicKey],
        publish: Publish,
    ) -> None:
        self.name = name
        self._label = label
        self._address = (space, agent, name)
        self._robot_type = robot_type
        self._driver = driver
        self._journal = journal
        self._cloud_clock = cloud_clock
        self._keys = keys
        self._publish = publish
        record = journal.device(name)
        gate = LeaseGate(epoch=record.epoch, burned=record.epoch)  # a restart ends whatever lease there was
        self._controller = Controller(robot_type, gate, latch=record.latch)
        self._controller.changed.set()
        self._loop = ControlLoop(robot_type, driver, self._controller, name=name, tell=self._tell)
        self._executor = Executor(robot_type, self._controller, observe=lambda: self._loop.seen, report=self._report)
        self._commands: queue.Queue[bytes] = queue.Queue(maxsize=1000)
        self._delivered: queue.SimpleQueue[Ack] = queue.SimpleQueue()
        self._sequences: dict[str, int] = {}
        self._told_lock = threading.Lock()
        self._twin: Twin | None = None
        self._link_up = threading.Event()
        self._stopping = threading.Event()
        self._shown: tuple[object, ...] = ()
        self._shown_at_s = float("-inf")
        self._thread = threading.Thread(target=self._office, name=f"{name}-office", daemon=True)
        self.refusals: dict[str, int] = {}

    # ------------------------------------------------------------ life

    def start(self) -> None:
        """Connect the driver and begin to hold.

        Raises:
            DriverError: The device is not there.
        """
        self._loop.start()
        self._twin = self._driver.twin()
        self._thread.start()

    def stop(self) -> None:
        """End what runs, hold, and let the driver go. May be called twice."""
        self._controller.lost(Refused("agent_stopping", "the agent was shut down"))
        self._executor.close()
        self._loop.stop()
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2)
        self._driver.close()

    @property
    def quiet(self) -> bool:
        """Whether nothing would be disturbed by a short break of the link."""
        return not self._controller.moving and self._executor.current() is None

    # ------------------------------------------------------------ what arrives (transport's thread)

    def receive(self, topic: topics.Topic, payload: bytes) -> None:
        """Take in one message; quick, and never raises."""
        try:
            if topic.kind == topics.CTL:
                self._take_setpoint(topic.name, payload)
            elif topic.kind == topics.STOP:
                stop = codec.decode(payload, Stop)
                self._controller.stop(StopLatch(by=stop.by, reason=stop.reason, at_ms=wall_ms()))
                _log.warning("%s: stopped by %s", self.name, stop.by)
            elif topic.kind == topics.CMD:
                self._commands.put_nowait(payload)
        except Refused as refused:
            self._count(refused.code)
        except ProtocolError as error:
            self._count("malformed")
            _log.warning("%s: %s refused: %s", self.name, topic.kind, str(error)[:300])
        except queue.Full:
            self._count("overrun")

    def _take_setpoint(self, epoch: str, payload: bytes) -> None:
        setpoint = codec.decode(payload, Setpoint)
        if epoch != str(setpoint.epoch):
            raise Refused("no_lease", "the epoch in the topic and in the message differ")
        self._controller.offer(setpoint, now_s=time.monotonic(), tick_ms=tick_ms())

    def link_changed(self, up: bool) -> None:
        """The link came or went."""
        if up:
            self._link_up.set()
        else:
            self._controller.lost(Refused("link_lost", "the device lost its link"))

    # ------------------------------------------------------------ the office

    def _office(self) -> None:
        while not self._stopping.is_set():
            try:
                payload = self._commands.get(timeout=0.1)
            except queue.Empty:
                payload = None
            try:
                if payload is not None:
                    self._obey(payload)
                self._keep()
                if self._link_up.is_set():
                    self._link_up.clear()
                    self._introduce()
                self._show()
            except Exception:  # noqa: BLE001 (one bad command must not end the office)
                _log.exception("%s: command", self.name)
        self._keep()

    def _obey(self, payload: bytes) -> None:
        try:
            command = codec.decode(signing.verify(payload, self._keys), Command)
        except SignatureError as error:
            self._count("bad_signature")
            _log.warning("%s: command refused: %s", self.name, error)
            return
        except ProtocolError as error:
            self._count("malformed")
            _log.warning("%s: command refused: %s", self.name, str(error)[:300])
            return
        if (command.space, command.agent, command.device) != self._address:
            self._count("wrong_address")
            return
        first = self._ack(command.id, AckStatus.RECEIVED)
        seen = self._journal.begin(self.name, first)
        if seen is not None:
            self._send_ack(seen)
            return
        try:
            self._check_time(command)
            self._carry_out(command)
        except Refused as refused:
            status = AckStatus.EXPIRED if refused.code == "expired" else AckStatus.FAILED
            self._report(command.id, status, reason=Reason(code=refused.code, message=refused.message))
            _log.info("%s: command %s refused: %s", self.name, command.id, refused.message)

    def _check_time(self, command: Command) -> None:
        if isinstance(command.request, StopDevice):
            return  # a late Stop is still a Stop
        now_ms = self._cloud_clock.now_ms()
        if now_ms is None:
            raise Refused("no_clock", "the device does not know the cloud's time yet; send it again")
        if now_ms > command.issued_at_ms + command.ttl_ms:
            late = round(now_ms - command.issued_at_ms - command.ttl_ms)
            raise Refused("expired", f"arrived {late} ms after it had run out")
        if command.issued_at_ms > now_ms + _FUTURE_MS:
            raise Refused("from_the_future", "issued later than now; the cloud's clock or this device's is wrong")

    def _carry_out(self, command: Command) -> None:
        match command.request:
            case GrantLease(holder=holder, lease_ms=lease_ms):
                self._controller.grant(
                    epoch=command.epoch, holder=holder, lease_s=lease_ms / 1000, now_s=time.monotonic()
                )
            case ReleaseLease():
                self._controller.release(epoch=command.epoch)
            case StopDevice(reason=reason):
                self._controller.stop(StopLatch(by=command.who, reason=reason, at_ms=wall_ms()))
            case ResetStop():
                self._controller.reset_stop()
                _log.warning("%s: Stop reset by %s", self.name, command.who)
            case CancelAction(action=action):
                self._executor.cancel(action, command.who)
            case RunMovement() | MoveJoints():
                # Journalled as accepted before it begins: after a crash here it is ended, never run again.
                self._report(command.id, AckStatus.ACCEPTED)
                self._executor.start(command)
                self._keep()
                return
        self._keep()
        self._report(command.id, AckStatus.DONE)

    def _keep(self) -> None:
        """Write down epochs and latch when they have changed, and which answers have arrived."""
        while not self._delivered.empty():
            self._journal.delivered(self._delivered.get())
        if self._controller.changed.is_set():
            self._controller.changed.clear()
            epoch, burned = self._controller.epochs
            self._journal.save_epoch(self.name, epoch=epoch, burned=burned)
            self._journal.save_latch(self.name, self._controller.latch)

    # ------------------------------------------------------------ what is told

    def _ack(self, command: str, status: AckStatus, **more: object) -> Ack:
        with self._told_lock:
            sequence = self._sequences.get(command, 0) + 1
            if status.terminal:
                self._sequences.pop(command, None)
            else:
                self._sequences[command] = sequence
        return Ack(id=command, status=status, sequence=sequence, at_ms=wall_ms(), tick_ms=tick_ms(), **more)  # type: ignore[arg-type]

    def _report(self, command: str, status: AckStatus, **more: object) -> None:
        ack = self._ack(command, status, **more)
        self._journal.record(ack)
        self._send_ack(ack)

    def _send_ack(self, ack: Ack) -> None:
        self._publish(self._topic(topics.ACK), codec.encode(ack), qos=1, delivered=lambda: self._delivered.put(ack))

    def _introduce(self) -> None:
        """After each connection: what the device is, how it is, and the answers that may not have arrived."""
        self._publish(
            self._topic(topics.DESC),
            codec.encode(self._description(), limit=codec.MAX_RETAINED_BYTES),
            qos=1,
            retain=True,
        )
        if self._twin is not None:
            self._publish(
                self._topic(topics.DESC, topics.TWIN),
                codec.encode(self._twin, limit=codec.MAX_RETAINED_BYTES),
                qos=1,
                retain=True,
            )
        self._shown_at_s = float("-inf")
        for ack in self._journal.undelivered(self.name):
            self._send_ack(ack)

    def _show(self) -> None:
        """Publish ``state`` on change, at most once a second, and every 30 s."""
        now_s = time.monotonic()
        lease = self._controller.lease(now_s)
        epoch, _ = self._controller.epochs
        fault = self._controller.fault
        action = self._executor.current()
        shown = (self._controller.mode, epoch, lease, self._controller.latch, fault, action and action.id)
        age_s = now_s - self._shown_at_s
        if age_s < STATE_GAP_S or (shown == self._shown and age_s < STATE_EVERY_S):
            return
        at_ms = wall_ms()
        state = State(
            device=self.name,
            at_ms=at_ms,
            tick_ms=tick_ms(),
            mode=self._controller.mode,
            epoch=epoch,
            stop=self._controller.latch,
            lease=_lease_state(lease, now_s),
            action=action,
            faults=(Fault(code="driver", message=fault[:2000], since_ms=at_ms),) if fault else (),
        )
        if self._publish(
            self._topic(topics.STATE), codec.encode(state, limit=codec.MAX_RETAINED_BYTES), qos=1, retain=True
        ):
            self._shown, self._shown_at_s = shown, now_s

    def _description(self) -> Description:
        kind = self._robot_type
        return Description(
            device=self.name,
            kind=kind.kind,
            robot_type=kind.type,
            label=self._label,
            joints=kind.joints,
            frames=kind.frames,
            capabilities=kind.capabilities,
            streams=kind.streams,
            watchdog_ms=round(WATCHDOG_S * 1000),
            max_loop_age_ms=round(MAX_LOOP_AGE_S * 1000),
            simulated=self._driver.simulated,
        )

    def _tell(self, telemetry: JointTelemetry) -> None:
        self._publish(self._topic(topics.TELE, "joints"), codec.encode(telemetry), qos=0)

    def _topic(self, kind: str, name: str = "") -> str:
        return topics.device(*self._address, kind, name)

    def _count(self, code: str) -> None:
        self.refusals[code] = self.refusals.get(code, 0) + 1


def _lease_state(lease: Lease | None, now_s: float) -> LeaseState | None:
    if lease is None:
        return None
    left_ms = max(0, round((lease.expires_s - now_s) * 1000))
    return LeaseState(holder=lease.holder, epoch=lease.epoch, expires_in_ms=left_ms)
