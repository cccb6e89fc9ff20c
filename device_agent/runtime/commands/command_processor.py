"""The office of one device: a thread that obeys signed commands one by one and writes the journal.

The control loop never waits for disk or network; this thread does.
"""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from functools import partial

from device_agent.ports.clock import CloudClock, wall_ms
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
    StopDevice,
    StopLatch,
    Twin,
    WithdrawRequest,
    codec,
)
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.events import EventKind
from device_agent.protocol.security import signing
from device_agent.runtime.actions.executor import ActionExecutor
from device_agent.runtime.authority.control_request import PendingControlRequest
from device_agent.runtime.authority.event_recorder import EventRecord, EventRecorder
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused
from device_agent.runtime.storage.journal import Journal, JournalError
from device_agent.runtime.telemetry.device_publisher import DevicePublisher, StateSnapshot

_FUTURE_MS = 2000
"""A command may seem issued this much later than now: more than the error of the clock estimate ever is."""
_MOST_WAITING = 1000
_log = logging.getLogger(__name__)


class CommandProcessor:
    """Takes in commands, one after another.

    Args:
        address: Space, agent and name of the device: what a command must be bound to.
        controller: Leases, Stop.
        executor: Actions.
        voice: Answers.
        audit: What happened, to be told.
        journal: Open.
        cloud_clock: For ``ttl_ms``.
        keys: The cloud's keys, as far as they are pinned.
        hurry: Called when a Stop has come: it waits for no control period.
        ailing: What is wrong with the device though its driver raises no error.
    """

    def __init__(
        self,
        *,
        address: tuple[str, str, str],
        controller: Controller,
        executor: ActionExecutor,
        voice: DevicePublisher,
        audit: EventRecorder,
        journal: Journal,
        cloud_clock: CloudClock,
        keys: PinnedKeys,
        hurry: Callable[[], None],
        ailing: Callable[[], tuple[Fault, ...]] = tuple,
    ) -> None:
        self._address = address
        self._name = address[2]
        self._controller = controller
        self._executor = executor
        self._voice = voice
        self._audit = audit
        self._journal = journal
        self._cloud_clock = cloud_clock
        self._keys = keys
        self._hurry = hurry
        self._ailing = ailing
        self._handover = PendingControlRequest()
        self._twin: Twin | None = None
        self._commands: queue.Queue[bytes] = queue.Queue(maxsize=_MOST_WAITING)
        self._introduce = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{self._name}-office", daemon=True)

    def start(self, twin: Twin | None) -> None:
        """Begin to work.

        Args:
            twin: The drawing that ``introduce`` shows.
        """
        self._twin = twin
        self._thread.start()

    def stop(self) -> None:
        """Write down what is left, and end. May be called twice."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2)

    def put(self, payload: bytes) -> None:
        """Hand in a command as it arrived; never blocks.

        Raises:
            Refused: Too many wait.
        """
        try:
            self._commands.put_nowait(payload)
        except queue.Full as error:
            raise Refused("overrun", f"{_MOST_WAITING} commands wait already") from error

    def introduce(self) -> None:
        """The link has come: say soon what the device is, and what may not have been heard."""
        self._voice.link_came()
        self._introduce.set()

    def _run(self) -> None:
        while not self._stopping.is_set():
            with contextlib.suppress(queue.Empty):
                payload = self._commands.get(timeout=0.1)
                self._guarded(partial(self._obey, payload))
            # Each by itself: with a full disk, what is shown and told must go on.
            for step in (self._keep, self._show, self._tell):
                self._guarded(step)
        self._guarded(self._keep)
        self._guarded(partial(self._tell, last=True))

    def _guarded(self, step: Callable[[], None]) -> None:
        """One bad command, or a disk that is full, must not end the office."""
        try:
            step()
        except JournalError as error:
            self._journal_failed(error)
        except Exception:  # noqa: BLE001 (see above)
            _log.exception("%s: office", self._name)

    def _journal_failed(self, error: JournalError) -> None:
        happened = EventRecord(EventKind.JOURNAL_FAILED, str(error), "error")
        self._audit.refused(happened, code="journal", now_s=time.monotonic())

    def _show(self) -> None:
        if self._introduce.is_set():
            self._introduce.clear()
            self._voice.introduce(self._twin)
        self._voice.show(self._condition())

    def _tell(self, *, last: bool = False) -> None:
        """Tell what happened; at the last also what a flood has still to say."""
        for happened in self._audit.take(float("inf") if last else time.monotonic()):
            if happened.severity == "error":
                _log.error("%s: %s", self._name, happened.message)
            self._voice.event(happened)

    # ------------------------------------------------------------ one command

    def _obey(self, payload: bytes) -> None:
        try:
            command = codec.decode(signing.verify(payload, self._keys), Command)
        except SignatureError as error:
            self._refuse("bad_signature", str(error))
            return
        except ProtocolError as error:
            self._refuse("malformed", str(error)[:300])
            return
        if (command.space, command.agent, command.device) != self._address:
            self._refuse("wrong_address", "it is addressed to another device", command)
            return
        first = self._voice.ack(command.id, AckStatus.RECEIVED)
        seen = self._journal.begin(self._name, first)
        if seen is not None:
            self._voice.send_ack(seen)
            return
        try:
            self._check_time(command)
            self._write_down(command.epoch)
            self._carry_out(command)
        except Refused as refused:
            self._end_refused(command, refused)
        except JournalError:
            raise
        except Exception as error:  # noqa: BLE001 (whoever asked must hear an end of it)
            _log.exception("%s: command %s", self._name, command.id)
            self._end_refused(command, Refused("internal", f"internal error: {error}; look at the agent's log"))

    def _end_refused(self, command: Command, refused: Refused) -> None:
        status = AckStatus.EXPIRED if refused.code == "expired" else AckStatus.FAILED
        self._voice.report(command.id, status, reason=Reason(code=refused.code, message=refused.message[:2000]))
        self._refuse(refused.code, refused.message[:2000], command)

    def _refuse(self, code: str, message: str, command: Command | None = None) -> None:
        _log.warning("%s: command %s refused: %s", self._name, command.id if command else "", message)
        self._voice.count(code)
        data: dict[str, object] = {"code": code}
        if command is not None:
            request = type(command.request).__struct_config__.tag
            data |= {"command": command.id, "request": request, "caller": command.caller, "epoch": command.epoch}
        happened = EventRecord(EventKind.COMMAND_REJECTED, f"a command was refused: {message}", "warning", data)
        self._audit.refused(happened, code=code, now_s=time.monotonic())

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

    def _write_down(self, epoch: int) -> None:
        """Journal a newer epoch before it is obeyed: killed in between, the agent must not obey an older one again."""
        known, burned = self._controller.epochs
        if epoch > known:
            self._journal.save_epoch(self._name, epoch=epoch, burned=burned)

    def _carry_out(self, command: Command) -> None:
        now_s = time.monotonic()
        match command.request:
            case GrantLease(holder=holder, lease_ms=lease_ms, reason=reason):
                self._controller.grant(
                    epoch=command.epoch, holder=holder, lease_s=lease_ms / 1000, now_s=now_s, reason=reason
                )
            case RequestControl() as asked:
                self._handover.ask(asked, epoch=command.epoch, lease=self._controller.lease(now_s), now_s=now_s)
            case WithdrawRequest(request=request):
                self._handover.drop(request)
            case ReleaseLease():
                self._controller.release(epoch=command.epoch)
            case StopDevice(reason=reason):
                self._controller.stop(StopLatch(caller=command.caller, reason=reason, at_ms=wall_ms()))
                self._hurry()
            case ResetStop():
                latched = self._controller.latch is not None
                self._controller.reset_stop(epoch=command.epoch)
                if latched:
                    message = f"Stop was reset by {command.caller}"
                    self._audit.note(EventRecord(EventKind.STOP_RESET, message, data={"caller": command.caller}))
                _log.warning("%s: Stop reset by %s", self._name, command.caller)
            case RotateKey(statements=statements):
                self._keys.follow(statements)
            case CancelAction(action=action):
                self._executor.cancel(action, command.caller)
            case order:  # an action
                # Journalled before it begins: after a crash here it is ended, never run again.
                self._voice.pass_by(command.id, AckStatus.ACCEPTED)
                self._executor.start(command, order)
                self._keep()
                return
        self._keep()
        self._voice.report(command.id, AckStatus.DONE)

    # ------------------------------------------------------------ what is kept and shown

    def _keep(self) -> None:
        """Write down epochs and latch when they have changed, and which answers have arrived."""
        self._voice.keep()
        if self._controller.changed.is_set():
            self._controller.changed.clear()
            epoch, burned = self._controller.epochs
            try:
                self._journal.save_epoch(self._name, epoch=epoch, burned=burned)
                self._journal.save_latch(self._name, self._controller.latch)
            except JournalError:
                self._controller.changed.set()  # still to be written, as soon as that goes again
                raise

    def _faults(self) -> tuple[Fault, ...]:
        """What lasts: an error of the driver, or else what it does not tell of itself."""
        fault = self._controller.fault
        if fault is not None:
            return (Fault(code="driver", message=fault[:2000], since_ms=wall_ms()),)
        return self._ailing()

    def _condition(self) -> StateSnapshot:
        now_s = time.monotonic()
        epoch, ended = self._controller.epochs
        lease = self._controller.lease(now_s)
        return StateSnapshot(
            mode=self._controller.mode,
            epoch=epoch,
            ended=ended,
            lease=lease,
            asked=self._handover.current(lease, now_s),
            latch=self._controller.latch,
            faults=self._faults(),
            action=self._executor.current(),
            restrictions=tuple(
                Restriction(source=one.source, speed=one.speed, reason=one.why) for one in self._controller.restrictions
            ),
            stiffness=self._controller.slack,
        )
