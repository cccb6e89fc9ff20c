"""Observes the real agents, and checks what each device does against a model of epochs, Stop and actions."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from device_agent.protocol import AckStatus, Mode
from device_agent.runtime.actions.executor import ActionExecutor
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.setpoint_stream import MAX_LOOP_AGE_S, WATCHDOG_S
from device_agent.runtime.telemetry.device_publisher import DevicePublisher
from tests.simulation.checks.history import History
from tests.simulation.plan import PEOPLE

_LATE_S = 0.1
"""Tolerance of the watchdog: two control periods, and the interruptions of threads [s]."""
_BRAKING_PERIODS = 8
_OVERLAP_S = 0.1
"""Time between the end of an action's reservation and its terminal ack [s]."""
_LINK_S = 0.1
_SOURCES = frozenset({Mode.STREAMING, Mode.ACTION})


@dataclass
class DeviceModel:
    """What one device may do, from the signed commands that it processed. Survives restarts.

    Attributes:
        newest: Highest epoch of a signed command.
        burned: Highest epoch that has ended, as far as commands and time decide it.
        burns: When [s] which epoch ended, also by a hold or fault of the real controller.
        leases: Epoch → expiry, virtual time [s].
        holders: Epoch → holder of the first grant.
        latched: Whether Stop is latched.
        latch_confirmed: Whether a caller received the confirmation of this latch.
        stopped_s: Virtual time of the last period in which the control loop applied the Stop [s].
        starts: Action → number of executions.
        ending: Action → terminal status that the agent reports. A process that is killed while it reports may have
            stored it.
        ended: Action → terminal status at the robot.
    """

    name: str
    newest: int = 0
    burned: int = 0
    burns: list[tuple[float, int]] = field(default_factory=list)
    controller: Any = None
    leases: dict[int, float] = field(default_factory=dict)
    holders: dict[int, str] = field(default_factory=dict)
    latched: bool = False
    latch_confirmed: bool = False
    stopped_s: float = -1.0
    setpoint_s: float = -1e9
    position_rad: float = 0.0
    braking: int = 0
    resumed_s: float = -1e9
    running: str = ""
    overlap: tuple[str, float] | None = None
    starts: Counter[str] = field(default_factory=Counter)
    ending: dict[str, str] = field(default_factory=dict)
    ended: dict[str, str] = field(default_factory=dict)
    issued: dict[str, tuple[int, int]] = field(default_factory=dict)


class RobotChecks:
    """Checks of all devices.

    Args:
        history: Receives facts and violations.
        now_s: Virtual time [s].
        slow_s: Delay that the driver of a device has now [s].
        late_s: How late a command started: of device, action and time to live [ms]; positive: too late.
    """

    def __init__(
        self,
        history: History,
        *,
        now_s: Callable[[], float],
        slow_s: Callable[[str], float],
        late_ms: Callable[[str, str, int], float],
    ) -> None:
        self._history = history
        self._now_s = now_s
        self._slow_s = slow_s
        self._late_ms = late_ms
        self.models: dict[str, DeviceModel] = {}
        self._by_part: dict[int, DeviceModel] = {}
        self._parts: list[Any] = []

    # ------------------------------------------------------------ processes

    def built(self, device_id: str, device: Any, position_rad: float) -> None:
        """A process has created the device."""
        model = self.models.setdefault(device_id, DeviceModel(device_id))
        for part in (device._controller, device._executor, device.publisher):
            self._by_part[id(part)] = model
            self._parts.append(part)  # keeps the id unique
        self._burn(model, model.newest)
        model.controller = device._controller
        model.position_rad = position_rad
        latched = device._controller.latch is not None
        if model.latch_confirmed and not latched:
            self._violate("stop-latch-lost", model, "a confirmed Stop latch did not survive the restart")
        model.latched = latched
        epoch = device._controller.epochs[0]
        if epoch < model.newest:
            self._violate("epoch-lost", model, f"it restarted with epoch {epoch} after {model.newest}")

    def killed(self, device_id: str) -> None:
        """The process of the device has ended."""
        model = self.models.get(device_id)
        if model is not None:
            model.running, model.overlap = "", None

    def resumed(self, device_id: str) -> None:
        """The process was suspended until now."""
        if device_id in self.models:
            self.models[device_id].resumed_s = self._now_s()

    def stop_confirmed(self, device_id: str, invoked_s: float) -> None:
        """A caller received the confirmation of a Stop that was requested at ``invoked_s``."""
        model = self.models[device_id]
        if model.stopped_s < invoked_s:
            self._violate("stop-not-executed", model, "Stop was confirmed, but the control loop has not applied it")
        model.latch_confirmed = model.latched

    def ended_s(self, device_id: str, epoch: int) -> float:
        """When the device ended an epoch; infinite if it has not [s]."""
        return next((at_s for at_s, burned in self.models[device_id].burns if burned >= epoch), float("inf"))

    # ------------------------------------------------------------ calls inside the agent

    @contextmanager
    def observing(self) -> Iterator[None]:
        """Observe the methods of the runtime within a ``with`` block."""
        undo: list[tuple[type, str, Any]] = []

        def observe(
            owner: type, name: str, after: Callable[..., None], before: Callable[..., None] | None = None
        ) -> None:
            original = getattr(owner, name)

            def observed(part: Any, *args: Any, **kwargs: Any) -> Any:
                model = self._by_part.get(id(part))
                if model is not None and before is not None:
                    before(model, *args, **kwargs)
                result = original(part, *args, **kwargs)
                if model is not None:
                    after(model, *args, **kwargs)
                return result

            undo.append((owner, name, original))
            setattr(owner, name, observed)

        observe(Controller, "grant", self._granted)
        observe(Controller, "release", self._released)
        observe(Controller, "reset_stop", self._reset)
        observe(Controller, "reserve", self._reserved)
        observe(Controller, "accept_setpoint", self._accepted)
        observe(Controller, "stop", self._stopped)
        observe(Controller, "record_period", self._period)
        observe(ActionExecutor, "start", self._started)
        observe(DevicePublisher, "report", self._reported, self._reporting)
        try:
            yield
        finally:
            for owner, name, original in reversed(undo):
                setattr(owner, name, original)

    def _granted(self, model: DeviceModel, *, epoch: int, holder: str, lease_s: float, **_: Any) -> None:
        self._note(model, f"grant epoch={epoch} holder={holder} lease_s={lease_s}")
        self._check_epoch(model, epoch, "a lease")
        model.newest = max(model.newest, epoch)
        model.leases[epoch] = self._now_s() + lease_s
        if model.holders.setdefault(epoch, holder) != holder:
            self._violate("shared-epoch-at-robot", model, f"{model.holders[epoch]} and {holder} hold epoch {epoch}")

    def _released(self, model: DeviceModel, *, epoch: int) -> None:
        self._note(model, f"release epoch={epoch}")
        if epoch < model.newest:
            self._violate("stale-epoch", model, f"it released epoch {epoch} after {model.newest}")
        self._burn(model, epoch)

    def _reset(self, model: DeviceModel, *, epoch: int) -> None:
        self._note(model, f"reset epoch={epoch}")
        self._check_epoch(model, epoch, "a reset")
        self._burn(model, epoch)
        model.latched = model.latch_confirmed = False

    def _reserved(self, model: DeviceModel, *, epoch: int, **_: Any) -> None:
        self._check_epoch(model, epoch, "an action")
        if model.latched:
            self._violate("moved-while-stopped", model, f"an action of epoch {epoch} started while Stop was latched")
        model.newest = max(model.newest, epoch)

    def _accepted(self, model: DeviceModel, setpoint: Any, *, tick_ms: int, **_: Any) -> None:
        now_s, epoch = self._now_s(), setpoint.epoch
        self._check_epoch(model, epoch, "a setpoint")
        sender = PEOPLE[round(setpoint.sent_ms)]
        if model.holders.get(epoch) != sender:
            self._violate(
                "foreign-setpoint", model, f"{sender} moved it in epoch {epoch} of {model.holders.get(epoch)}"
            )
        if model.leases.get(epoch, -1.0) + _LINK_S < now_s:
            self._violate("expired-lease", model, f"a setpoint of epoch {epoch} moved it after the lease expired")
        if tick_ms - setpoint.echo_tick_ms > MAX_LOOP_AGE_S * 1000:
            self._violate("old-setpoint", model, f"a setpoint with a loop age of {tick_ms - setpoint.echo_tick_ms} ms")
        if model.latched:
            self._violate("moved-while-stopped", model, "it accepted a setpoint while Stop was latched")
        model.setpoint_s = now_s

    def _stopped(self, model: DeviceModel, latch: Any, **_: Any) -> None:
        self._note(model, f"stop by={latch.caller}")
        model.latched = True
        self._burn(model, model.newest)

    def _period(self, model: DeviceModel, output: Any) -> None:
        now_s = self._now_s()
        moved = abs(output.position_rad[0] - model.position_rad) > 1e-9
        model.position_rad = output.position_rad[0]
        if output.mode is Mode.STOPPED:
            model.stopped_s = now_s
        model.burns.append((now_s, model.controller.epochs[1]))
        lease_end_s = model.leases.get(model.newest)
        if lease_end_s is not None and now_s > lease_end_s + _LINK_S + self._slow_s(model.name):
            self._burn(model, model.newest)
        model.braking = model.braking + 1 if moved and output.mode not in _SOURCES else 0
        if model.braking > _BRAKING_PERIODS:
            self._violate("no-rest", model, f"it still moves in mode {output.mode.value}")
        late_s = now_s - model.setpoint_s - WATCHDOG_S - _LATE_S - self._slow_s(model.name)
        if moved and output.mode is Mode.STREAMING and late_s > 0 and now_s - model.resumed_s > _LATE_S:
            self._violate("watchdog", model, f"it moves {late_s + WATCHDOG_S:.3f} s after the last fresh setpoint")
        if moved and output.mode in _SOURCES and model.latched and model.braking > 1:
            self._violate("moved-while-stopped", model, f"it moves in mode {output.mode.value}")

    def _started(self, model: DeviceModel, command: Any, _request: Any) -> None:
        now_s = self._now_s()
        self._note(model, f"starts {_short(command.id)} epoch={command.epoch}")
        model.starts[command.id] += 1
        if model.starts[command.id] > 1:
            self._violate("ran-twice", model, f"action {_short(command.id)} ran {model.starts[command.id]} times")
        if model.running:
            model.overlap = (model.running, now_s)
        model.running = command.id
        late_ms = self._late_ms(model.name, command.id, command.ttl_ms)
        if late_ms > 0:
            self._violate("after-ttl", model, f"action {_short(command.id)} started {late_ms:.0f} ms after its ttl")

    def _reporting(self, model: DeviceModel, command: str, status: AckStatus, **_: Any) -> None:
        if status.terminal and command in model.starts:
            model.ending[command] = status.value

    def _reported(self, model: DeviceModel, command: str, status: AckStatus, **fields: Any) -> None:
        if not status.terminal or command not in model.starts:
            return
        reason = fields.get("reason")
        self._note(model, f"ends {_short(command)} {status.value}" + (f" ({reason.code})" if reason else ""))
        if command in model.ended:
            self._violate(
                "ended-twice", model, f"action {_short(command)}: {model.ended[command]}, then {status.value}"
            )
        model.ended[command] = status.value
        if model.running == command:
            model.running = ""
        if model.overlap is not None and model.overlap[0] == command:
            if self._now_s() - model.overlap[1] > _OVERLAP_S + self._slow_s(model.name):
                self._violate("two-actions", model, f"action {_short(command)} still ran when another one started")
            model.overlap = None

    # ------------------------------------------------------------ helpers

    def _check_epoch(self, model: DeviceModel, epoch: int, what: str) -> None:
        if epoch < model.newest:
            self._violate("stale-epoch", model, f"it accepted {what} of epoch {epoch} after {model.newest}")
        elif epoch <= model.burned:
            self._violate("burned-epoch", model, f"it accepted {what} of epoch {epoch}, which had ended")

    def _burn(self, model: DeviceModel, epoch: int) -> None:
        model.newest = max(model.newest, epoch)
        model.burned = max(model.burned, epoch)
        model.burns.append((self._now_s(), epoch))

    def _note(self, model: DeviceModel, text: str) -> None:
        self._history.note("robot", f"{model.name} {text}")

    def _violate(self, kind: str, model: DeviceModel, text: str) -> None:
        self._history.violate(kind, f"{model.name}: {text}")


def _short(action: str) -> str:
    """The random part of an action's id."""
    return action[-6:]
