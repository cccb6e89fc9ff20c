"""Processes a device's signed commands sequentially in its own thread; the only writer of the device's journal.

This thread may wait for disk and network; the control loop never does.
"""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from functools import partial

from device_agent.ports.clock import CloudClock, wall_ms
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.ports.tracing import CommandTraces
from device_agent.protocol import (
    AckStatus,
    CancelAction,
    Command,
    Fault,
    GrantLease,
    Reason,
    ReleaseLease,
    RequestControl,
    ResetStop,
    Restriction,
    RotateKey,
    SetCameraConsent,
    StopDevice,
    StopLatch,
    Twin,
    WithdrawRequest,
    codec,
    topics,
)
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.events import EventKind
from device_agent.protocol.fields import printable, trace_id
from device_agent.protocol.security import log_output, signing
from device_agent.runtime.actions.executor import ActionExecutor
from device_agent.runtime.authority.control_request import PendingControlRequest
from device_agent.runtime.authority.event_recorder import EventRecord, EventRecorder
from device_agent.runtime.authority.fault_reporter import FaultReporter
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import INTERNAL_ERROR, Refused
from device_agent.runtime.load import LoadGovernor
from device_agent.runtime.recording.camera_recorder import DeviceCameras
from device_agent.runtime.recording.device_recording import DeviceRecording
from device_agent.runtime.storage.journal import Journal, JournalError
from device_agent.runtime.telemetry.device_publisher import DevicePublisher, StateSnapshot

_FUTURE_MS = 2000
"""Tolerance for commands issued in the future; larger than the error of the clock estimate [ms]."""
_MAX_WAITING = 1000
FAULT_STABLE_S = 30.0
"""A fault is cleared when its condition has been absent for this long [s]."""
_OUTDATED = frozenset({"stale_epoch", "lease_ended"})
"""Codes of commands whose epoch the device no longer accepts; the cloud needs the device's epoch."""
_DRIVER = "driver"
"""Code of the driver's error."""
COMMAND_PROCESSOR = "command processor"
_RESPONSE_S = 3.0
"""A processor without progress for this time hangs [s]; a slow disk may delay a write for more than a second."""
_IDLE_S, _CONFIRM_S = 0.1, 0.01
"""Time between two checks of state and events, and of a Stop that the control loop has not applied yet [s]."""
_log = logging.getLogger(__name__)


class CommandProcessor:
    """Verifies, deduplicates, applies and acknowledges commands; publishes state and events."""

    def __init__(
        self,
        *,
        address: tuple[str, str, str],
        controller: Controller,
        executor: ActionExecutor,
        publisher: DevicePublisher,
        events: EventRecorder,
        journal: Journal,
        cloud_clock: CloudClock,
        keys: PinnedKeys,
        wake: Callable[[], None],
        load: LoadGovernor,
        traces: CommandTraces,
        device_faults: Callable[[], tuple[Fault, ...]] = tuple,
        recording: DeviceRecording | None = None,
        cameras: DeviceCameras | None = None,
        part_faults: Callable[[], tuple[Fault, ...]] = tuple,
    ) -> None:
        self._address = address
        self._name = address[2]
        self._controller = controller
        self._executor = executor
        self._publisher = publisher
        self._events = events
        self._journal = journal
        self._cloud_clock = cloud_clock
        self._keys = keys
        self._wake = wake
        self._load = load
        self._traces = traces
        self._device_faults = device_faults
        self._part_faults = part_faults
        self._recording = recording
        self._cameras = cameras
        self._control_request = PendingControlRequest()
        self._fault_reporter = FaultReporter(stable_s=FAULT_STABLE_S)
        self._pending_stops: dict[str, int] = {}
        self._twin: Twin | None = None
        self._fault_raised = False
        self._commands: queue.Queue[bytes] = queue.Queue(maxsize=_MAX_WAITING)
        self._connected = threading.Event()
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name=f"{self._name}-commands",
            part=COMMAND_PROCESSOR,
            device=self._name,
            stopping=self._stopping,
            recovery=Recovery.EXIT,
            within_s=_RESPONSE_S,
        )

    def start(self, twin: Twin | None) -> None:
        """Start to process commands. The drawing of the device is published after each connection."""
        self._twin = twin
        self._thread.start()

    def stop(self) -> None:
        """Journal and publish the rest, and end. May be called twice."""
        self._stopping.set()
        self._thread.join(timeout=2)

    def report_failure(self) -> None:
        """Publish state and events from another thread, because the processor's has ended or hangs."""
        if not self._thread.is_alive():
            self._guarded(self._publish_state)
        self._guarded(partial(self._publish_events, last=True))

    def submit(self, payload: bytes) -> None:
        """Add a received command to the queue; never blocks.

        Raises:
            Refused: The queue is full.
        """
        try:
            self._commands.put_nowait(payload)
        except queue.Full as error:
            raise Refused("overrun", f"{_MAX_WAITING} commands are waiting already") from error

    def on_connected(self) -> None:
        """Publish the description, state and unacknowledged acks soon: the link is up."""
        self._connected.set()

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._thread.beat()
            with contextlib.suppress(queue.Empty):
                payload = self._commands.get(timeout=_CONFIRM_S if self._pending_stops else _IDLE_S)
                self._guarded(partial(self._process, payload))
            log_output.context.set(None)
            # Guarded separately: with a full disk, state and events are still published.
            for step in (
                self._write_journal,
                self._confirm_stops,
                self._publish_state,
                self._publisher.repeat_acks,
                self._publish_events,
            ):
                self._guarded(step)
        self._guarded(self._write_journal)
        self._guarded(partial(self._publish_events, last=True))

    def _guarded(self, step: Callable[[], None]) -> None:
        """Keep the thread alive on an invalid command or a full disk."""
        try:
            step()
        except JournalError as error:
            event = EventRecord(EventKind.JOURNAL_FAILED, str(error), "error")
            self._events.record_rejection(event, code="journal", now_s=time.monotonic())
        except Exception:  # noqa: BLE001 (see above)
            _log.exception("%s: command processor", self._name)

    def _publish_state(self) -> None:
        if self._connected.is_set():
            self._connected.clear()
            self._publisher.publish_description(self._twin)
        self._publisher.update_description()
        snapshot = self._snapshot()
        self._publisher.publish_state(snapshot, urgent=self._fault_raised)

    def _publish_events(self, *, last: bool = False) -> None:
        """Publish the recorded events; at the last call also counted rejections."""
        for event in self._events.drain(float("inf") if last else time.monotonic()):
            if event.severity == "error":
                _log.error("%s: %s", self._name, event.message)
            self._publisher.publish_event(event)

    # ------------------------------------------------------------ one command

    def _process(self, payload: bytes) -> None:
        try:
            command = codec.decode(signing.verify(payload, self._keys), Command)
        except SignatureError as error:
            self._record_rejection("bad_signature", str(error))
            return
        except ProtocolError as error:
            self._record_rejection("malformed", str(error)[:300])
            return
        trace = trace_id(command.traceparent)
        log_output.context.set(lambda: {"device": self._name, "action": command.id, "trace_id": trace})
        if (command.space, command.agent, command.device) != self._address:
            self._record_rejection("wrong_address", "it is addressed to another device", command)
            return
        first = self._publisher.create_ack(command.id, AckStatus.RECEIVED, traceparent=command.traceparent)
        previous = self._journal.begin(self._name, first, issued_ms=command.issued_at_ms, epoch=command.epoch)
        if previous is not None:
            self._publisher.send_ack(previous)
            return
        self._traces.begin(command)
        try:
            self._check_time(command)
            self._journal_epoch(command.epoch)
            self._apply(command)
        except Refused as refused:
            self._reject(command, refused)
        except JournalError:
            raise
        except Exception:  # noqa: BLE001 (every command gets a terminal ack)
            _log.exception("%s: command %s", self._name, command.id)
            self._reject(command, Refused("internal", INTERNAL_ERROR))

    def _reject(self, command: Command, refused: Refused) -> None:
        status = AckStatus.EXPIRED if refused.code == "expired" else AckStatus.FAILED
        epoch = self._controller.epochs[0] if refused.code in _OUTDATED else 0
        reason = Reason(code=refused.code, message=refused.message[:2000], epoch=epoch)
        self._publisher.report(command.id, status, reason=reason)
        self._record_rejection(refused.code, refused.message[:2000], command)

    def _record_rejection(self, code: str, message: str, command: Command | None = None) -> None:
        _log.warning("%s: command %s rejected: %s", self._name, command.id if command else "", message)
        self._publisher.count_rejection(code)
        data: dict[str, object] = {"code": code}
        if command is not None:
            request = type(command.request).__struct_config__.tag
            data |= {"command": command.id, "request": request, "caller": command.caller, "epoch": command.epoch}
        event = EventRecord(EventKind.COMMAND_REJECTED, f"a command was rejected: {message}", "warning", data)
        self._events.record_rejection(event, code=code, now_s=time.monotonic())

    def _check_time(self, command: Command) -> None:
        if isinstance(command.request, StopDevice):
            return  # a late Stop still stops
        now_ms = self._cloud_clock.now_ms()
        if now_ms is None:
            raise Refused("no_clock", "the device does not know the cloud's time yet; retry")
        if now_ms > command.issued_at_ms + command.ttl_ms:
            late = round(now_ms - command.issued_at_ms - command.ttl_ms)
            raise Refused("expired", f"arrived {late} ms after it had expired")
        if command.issued_at_ms > now_ms + _FUTURE_MS:
            raise Refused("from_the_future", "issued later than now; the cloud's clock or this device's is wrong")

    def _journal_epoch(self, epoch: int) -> None:
        """Journal a newer epoch before applying it, so that a restarted agent never accepts an older one."""
        highest, burned = self._controller.epochs
        if epoch > highest:
            self._journal.save_epoch(self._name, epoch=epoch, burned=burned)

    def _apply(self, command: Command) -> None:
        now_s = time.monotonic()
        match command.request:
            case GrantLease(holder=holder, lease_ms=lease_ms, reason=reason, pairing=pairing):
                topic = topics.device(*self._address, topics.CTL, str(command.epoch))
                self._controller.grant(
                    epoch=command.epoch,
                    holder=holder,
                    lease_s=lease_ms / 1000,
                    now_s=now_s,
                    reason=printable(reason),
                    keys=self._keys.setpoint_keys(topic, pairing),
                )
            case RequestControl() as request:
                lease = self._controller.lease(now_s)
                self._control_request.open(request, epoch=command.epoch, lease=lease, now_s=now_s)
            case WithdrawRequest(request=request):
                self._control_request.withdraw(request)
            case ReleaseLease():
                self._controller.release(epoch=command.epoch)
            case StopDevice(reason=reason):
                latch = StopLatch(caller=command.caller, reason=printable(reason), at_ms=wall_ms(), verified=True)
                self._pending_stops[command.id] = self._controller.stop(latch, message=command.id)
                self._wake()
                self._confirm_stops()
                return
            case ResetStop():
                self._reset_stop(command)
            case RotateKey(statements=statements):
                self._keys.follow(statements)
            case SetCameraConsent() as decision:
                self._decide_on_cameras(decision, command.caller)
            case CancelAction(action=action):
                self._executor.cancel(action, command.caller)
            case action:
                # Only the next ack, which follows soon, is journalled. After a crash the action is not run again.
                self._publisher.send_ack(self._publisher.create_ack(command.id, AckStatus.ACCEPTED))
                self._executor.start(command, action)
                self._write_journal()
                return
        self._write_journal()
        self._publisher.report(command.id, AckStatus.DONE)

    def _decide_on_cameras(self, decision: SetCameraConsent, caller: str) -> None:
        if self._cameras is None:
            raise Refused("cannot", "the cameras of this device cannot be recorded")
        self._cameras.decide(decision, caller=caller)

    def _confirm_stops(self) -> None:
        """Acknowledge each Stop that the control loop has applied. Without the loop, no Stop is acknowledged."""
        self._write_journal()
        for command, number in list(self._pending_stops.items()):
            if self._controller.stop_applied(number):
                self._publisher.report(command, AckStatus.DONE)
                del self._pending_stops[command]

    def _reset_stop(self, command: Command) -> None:
        was_latched = self._controller.latch is not None
        self._controller.reset_stop(epoch=command.epoch)
        reset = Reason(code="reset", message="Stop was reset before the control loop had applied it")
        while self._pending_stops:
            self._publisher.report(self._pending_stops.popitem()[0], AckStatus.FAILED, reason=reset)
        message = f"Stop was reset by {command.caller}"
        if was_latched:
            self._events.record(EventRecord(EventKind.STOP_RESET, message, data={"caller": command.caller}))
        _log.warning("%s: %s", self._name, message)

    # ------------------------------------------------------------ journal and state

    def _write_journal(self) -> None:
        """Journal delivered acks, and epochs and latch if they have changed."""
        self._publisher.update_journal()
        if self._controller.changed.is_set():
            self._controller.changed.clear()
            epoch, burned = self._controller.epochs
            try:
                self._journal.save_epoch(self._name, epoch=epoch, burned=burned)
                self._journal.save_latch(self._name, self._controller.latch)
            except JournalError:
                self._controller.changed.set()  # written once the journal works again
                raise

    def _faults(self) -> tuple[Fault, ...]:
        """Open faults: of threads, those that the device reports, and the driver's error unless it is one of them."""
        error, present = self._controller.fault, self._part_faults() + self._device_faults()
        for each in (self._recording, self._cameras):
            present += () if each is None else each.faults()
        if error is not None and not any(error == fault.message for fault in present):
            present += (Fault(code=_DRIVER, message=error[:2000], since_ms=wall_ms()),)
        changes = self._fault_reporter.update(present)
        self._fault_raised = bool(changes.raised)
        for fault in changes.raised:
            if fault.code == _DRIVER:
                self._events.record(EventRecord(EventKind.DRIVER_FAILED, fault.message, "error"))
        for fault in changes.cleared:
            if fault.code == _DRIVER:
                data = {"count": fault.count}
                self._events.record(EventRecord(EventKind.DRIVER_RECOVERED, "the device responds again", data=data))
        return self._fault_reporter.faults

    def _snapshot(self) -> StateSnapshot:
        now_s = time.monotonic()
        epoch, ended = self._controller.epochs
        lease = self._controller.lease(now_s)
        return StateSnapshot(
            mode=self._controller.applied_mode,
            epoch=epoch,
            ended=ended,
            lease=lease,
            control_request=self._control_request.current(lease, now_s),
            latch=self._controller.latch,
            faults=self._faults(),
            action=self._executor.current(),
            restrictions=tuple(
                Restriction(source=item.source, speed=item.speed, reason=item.why)
                for item in self._controller.restrictions
            ),
            stiffness=self._controller.reduced_stiffness,
            load=self._load.level,
            recording=self._recording is not None and self._recording.active,
            recorded_cameras=() if self._cameras is None else self._cameras.recorded,
            camera_consent=None if self._cameras is None else self._cameras.consent,
        )
