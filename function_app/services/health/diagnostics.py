"""Compares new measurements with usual and allowed values, and raises faults.

Partition of ``Diagnostics``: device and pairing. Key: stream. A row contains the detector states of a stream and the
sums of the current window. It is written by ETag after the faults, so a restart finds consistent faults.
"""

import asyncio
import fnmatch
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from device_agent.protocol import Description, Diagnostic, topics
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent, Device
from function_app.domain.health import detectors, diagnosis
from function_app.domain.health.detectors import MINUTE_MS, WINDOW_MS, DetectorState, Limits
from function_app.domain.health.diagnosis import Health, Rule
from function_app.domain.health.faults import Fault, Report, Severity
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, Tables
from function_app.services.devices.device_access import DeviceAccess, DeviceView
from function_app.services.devices.spaces import Spaces
from function_app.services.health.faults import Faults
from function_app.services.robot_types.catalogue import RobotTypes
from function_app.services.storage import records

MAX_FIELDS = 100
"""Maximum number of monitored fields per stream: first those listed by the robot type, then others by name."""
RULES_MS = 60_000
"""Interval at which a device's rules are read again."""
_MAX_CACHED_RULES = 1_000
_MAX_CONCURRENT = 20

Values = Mapping[str, float]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FieldView:
    """One field with its limits and state."""

    stream: str
    name: str
    rule: Rule
    watch: DetectorState


@dataclass(frozen=True, slots=True)
class Summary:
    """A summary of a device's health."""

    view: DeviceView
    health: Health
    faults: tuple[Fault, ...]

    def count(self, severity: Severity) -> int:
        """Number of open faults with this severity."""
        return sum(fault.severity is severity for fault in self.faults)


@dataclass(frozen=True, slots=True)
class _StreamState:
    """Row content: start of the current window [ms], its sums and counts, and the detector states."""

    window_ms: int = 0
    sums: dict[str, tuple[float, int]] = field(default_factory=dict)
    watches: dict[str, DetectorState] = field(default_factory=dict)


class Diagnostics:
    """Monitors measurements and reports device health."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        faults: Faults,
        robot_types: RobotTypes,
        spaces: Spaces,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._faults = faults
        self._robot_types = robot_types
        self._spaces = spaces
        self._clock = clock
        self._rules: dict[tuple[str, str], tuple[int, tuple[Diagnostic, ...]]] = {}

    async def observe(self, device: Device, stream: str, means: Sequence[tuple[int, Values]]) -> None:
        """Process new measurements of a stream: time and mean over at most ten seconds. Late values are ignored.

        Raises ``busy``.
        """
        declared = await self._declared(device)
        names = {name for _, values in means for name in values}
        if not _rules(declared, stream, names):
            return
        reported: set[str] = set()

        async def attempt() -> None:
            row = await self._tables.get(records.DIAGNOSTICS, _partition(device), stream)
            existing = _StreamState() if row is None else records.read(row, _StreamState)
            rules = _rules(declared, stream, names | set(existing.sums) | set(existing.watches))
            after = existing
            for at_ms, values in sorted(means, key=lambda mean: mean[0]):
                after = _add_mean(after, rules, at_ms, values)
            if after is existing:
                return
            # Faults are updated on changes and every minute, which also repairs the state after a kill.
            before = {name for name, watch in existing.watches.items() if watch.findings}
            now = {name for name, watch in after.watches.items() if watch.findings}
            minute = existing.window_ms // MINUTE_MS != after.window_ms // MINUTE_MS
            if minute or now != before | reported or _has_new_breach(existing, after):
                await self._faults.settle(device, f"detector/{stream}", _reports(declared, stream, after))
                reported.update(now)
            data = records.to_data(after)
            if row is None:
                await self._tables.create(records.DIAGNOSTICS, Row(_partition(device), stream, data))
            else:
                await self._tables.replace(records.DIAGNOSTICS, row.changed(data))

        await records.retry(attempt)

    async def of_device(self, caller: Identity, device_id: str) -> tuple[Summary, list[FieldView]]:
        """Health of a device and of each monitored field. Raises ``device-unknown``."""
        view = await self._devices.view(caller, device_id)
        summary = await self._summary(view)
        declared = await self._declared(view.device)
        page = await self._tables.query(records.DIAGNOSTICS, _partition(view.device), limit=1000)
        fields = []
        for row in page.rows:
            watches = records.read(row, _StreamState).watches
            rules = _rules(declared, row.key, set(watches))
            fields += [
                FieldView(row.key, name, rules[name], watches[name]) for name in sorted(watches) if name in rules
            ]
        return summary, fields

    async def summaries(
        self, caller: Identity, *, space: str | None, cursor: str | None, limit: int
    ) -> tuple[list[Summary], str | None]:
        """Devices with their health, worst first, in pages of up to ``limit`` agents.

        Raises ``space-unknown`` or ``cursor-invalid``.
        """
        if space is not None:
            await self._spaces.get(caller, space)
        views, following = await self._devices.views(caller, cursor=cursor, limit=limit)
        chosen = [view for view in views if space in {None, view.device.space}]
        result: list[Summary] = []
        for first in range(0, len(chosen), _MAX_CONCURRENT):
            result += await asyncio.gather(*(self._summary(view) for view in chosen[first : first + _MAX_CONCURRENT]))
        return sorted(result, key=lambda summary: (-summary.health.rank, summary.view.device.id)), following

    async def _summary(self, view: DeviceView) -> Summary:
        faults = tuple(await self._faults.open(view.device))
        return Summary(view, diagnosis.health(faults, online=view.online), faults)

    async def _declared(self, device: Device) -> tuple[Diagnostic, ...]:
        """The declared measurements of a device: from its description, or from its robot type."""
        now_ms = self._clock.now_ms()
        key = (device.id, device.pairing)
        existing = self._rules.get(key)
        if existing is not None and 0 <= now_ms - existing[0] < RULES_MS:
            return existing[1]
        row = await self._tables.get(records.DESCRIPTIONS, device.agent, device.name)
        result = () if row is None else records.read(row, Description).diagnostics
        result = result or await self._of_type(device)
        if len(self._rules) >= _MAX_CACHED_RULES:
            self._rules.clear()
        self._rules[key] = (now_ms, result)
        return result

    async def _of_type(self, device: Device) -> tuple[Diagnostic, ...]:
        _, agent = await records.find(self._tables, records.AGENTS, device.agent, "agent", Agent)
        if agent is None or agent.account is None:
            return ()
        try:
            robot_type = await self._robot_types.get(Identity(agent.account, "", ""), device.robot_type)
        except Problem as problem:
            _log.debug("%s is monitored without limits: %s", device.id, problem.detail)
            return ()
        return robot_type.diagnostics


def _rules(declared: Sequence[Diagnostic], stream: str, names: set[str]) -> dict[str, Rule]:
    """The rule of each monitored field. Of the joint stream only listed fields are monitored."""
    result: dict[str, Rule] = {}
    for name in sorted(names):
        entry = next((one for one in declared if one.stream == stream and fnmatch.fnmatchcase(name, one.fields)), None)
        if entry is not None:
            limits = Limits(
                low=entry.low,
                high=entry.high,
                warning_low=entry.warning_low,
                warning_high=entry.warning_high,
                change=entry.change,
                horizon_s=entry.horizon_s,
                kinds=entry.checks,
            )
            result[name] = Rule(entry.label, entry.unit, entry.advice, limits, listed=True)
        elif stream != topics.JOINTS:
            result[name] = Rule(name.partition(".")[0])
    chosen = sorted(result, key=lambda name: (not result[name].listed, name))[:MAX_FIELDS]
    return {name: result[name] for name in chosen}


def _add_mean(state: _StreamState, rules: Mapping[str, Rule], at_ms: int, values: Values) -> _StreamState:
    """Add one mean; a mean of a later window closes the current window."""
    window_ms = at_ms // WINDOW_MS * WINDOW_MS
    if window_ms < state.window_ms:
        return state
    sums, watches = state.sums, state.watches
    if window_ms > state.window_ms:
        watches = dict(watches)
        for name, (total, count) in sums.items():
            if name in rules:
                watch = watches.get(name, DetectorState())
                watches[name] = detectors.update(watch, rules[name].limits, state.window_ms, total / count)
        watches = {name: watch for name, watch in watches.items() if name in rules}
        sums = {}
    sums = dict(sums)
    for name in rules:
        if name in values:
            total, count = sums.get(name, (0.0, 0))
            sums[name] = (total + values[name], count + 1)
    return _StreamState(window_ms, sums, watches)


def _has_new_breach(existing: _StreamState, after: _StreamState) -> bool:
    """Whether a field has newly exceeded a limit."""
    return any(
        watch.breach.on and not (name in existing.watches and existing.watches[name].breach.on)
        for name, watch in after.watches.items()
    )


def _reports(declared: Sequence[Diagnostic], stream: str, state: _StreamState) -> list[Report]:
    rules = _rules(declared, stream, set(state.watches))
    reports = [diagnosis.diagnose(rule, stream, name, state.watches[name]) for name, rule in rules.items()]
    return [report for report in reports if report is not None]


def _partition(device: Device) -> str:
    return f"{device.id}/{device.pairing}"
