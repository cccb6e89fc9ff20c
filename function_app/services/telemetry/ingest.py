"""Ingests telemetry of all devices through one queue into the series of each device.

Messages that arrive together are stored as one row, distributed to the series, and then deleted. If the process is
killed, a timer distributes the row; duplicate samples have no effect.

Telemetry of joints carries no names. Samples that arrive before the description of their device wait in the queue,
at most ``MAX_HELD`` rows of a device. The timer distributes them under the names of the description.
"""

import asyncio
import logging
import re
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from device_agent.protocol import Description, JointTelemetry, Measurements, Mode, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.topics import Topic
from function_app.domain.common.ids import new_id, split_device
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent, Device
from function_app.domain.telemetry import series
from function_app.domain.telemetry.series import MAX_FIELDS, MAX_MAGNITUDE, Samples
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.devices.device_access import devices_of
from function_app.services.storage import records
from function_app.services.telemetry.series_writer import Place, SeriesWriter

SHARDS = 8
CACHE_MS = 3_000
"""Cache time of an agent's row. For this time data of an unpaired agent are stored in its former pairing."""
MAX_CACHED = 1_000
BACKLOG_MS = 30_000
"""Rows older than this were left by a terminated process."""
DROP_MS = 3_600_000
"""Rows that could not be distributed for this time are dropped."""
MAX_HELD = 100
"""Maximum number of queue rows per device that wait for its description."""
MAX_ROW_BYTES = 200_000
"""Approximate maximum size of a queue row [bytes]."""
_BYTES_PER_VALUE = 11
"""Eight incompressible bytes in base64."""
_JOINT = re.compile(r"\A[A-Za-z0-9_-]{1,60}\Z")
_BACKLOG_ROWS = 20
_YIELD_EVERY = 20
"""Messages processed before the event loop runs other tasks: telemetry must not delay acks."""

Values = Mapping[str, float]
Observer = Callable[[Device, str, Sequence[tuple[int, Values]]], Awaitable[None]]
"""Called with new samples of a stream: the last time in each window of 10 s, and the means."""

_log = logging.getLogger(__name__)


class InboundMessage(NamedTuple):
    """A received message."""

    topic: Topic
    payload: bytes


@dataclass(frozen=True, slots=True)
class _Agent:
    """Cached data of an agent."""

    space: str | None
    devices: Mapping[str, Device]
    joints: Mapping[str, Sequence[str]]
    read_ms: int


class TelemetryIngest:
    """Ingests telemetry. Idempotent; messages of unclaimed agents are dropped."""

    def __init__(
        self,
        *,
        tables: Tables,
        writer: SeriesWriter,
        clock: Clock,
        observers: Sequence[Observer] = (),
        refuse: Callable[[str, int], str] = lambda _device, _bytes: "",
    ) -> None:
        """``refuse`` returns why a message of a device, of a size [bytes], is not stored; empty: it is stored."""
        self._tables = tables
        self._writer = writer
        self._clock = clock
        self._observers = tuple(observers)
        self._refuse = refuse
        self._agents: dict[str, _Agent] = {}
        self._held: Counter[str] = Counter()
        self._turn = 0

    async def ingest(self, messages: Iterable[InboundMessage]) -> dict[int, str]:
        """Ingest messages; on return their samples are stored in their series.

        Returns:
            Invalid, dropped messages: index in ``messages``, and reason.

        Raises:
            Problem: ``busy``: samples not yet in their series are in the queue, or must be delivered again.
            StoreError: As above.
        """
        dropped: dict[int, str] = {}
        parts: dict[tuple[str, str, bool], list[tuple[int, Values]]] = defaultdict(list)
        devices: dict[str, Device] = {}
        for number, message in enumerate(messages):
            if number % _YIELD_EVERY == 0:
                await asyncio.sleep(0)
            existing = await self._agent(message.topic.agent)
            device = existing.devices.get(message.topic.device)
            if device is None or existing.space != message.topic.space:
                continue
            joints = existing.joints.get(message.topic.device)
            if joints is not None:
                self._held.pop(device.id, None)
            try:
                sample = _sample(message, joints or ())
            except ProtocolError as error:
                _log.warning("%s of %s dropped: %s", message.topic.name, device.id, error)
                dropped[number] = str(error)
                continue
            if reason := self._refuse(device.id, len(message.payload)):
                dropped[number] = reason
                continue
            devices[device.id] = device
            parts[device.id, message.topic.name, joints is None and message.topic.name == topics.JOINTS].append(sample)
        gathered = [
            _Part(devices[id_], stream, series.from_rows(rows), unnamed)
            for (id_, stream, unnamed), rows in parts.items()
        ]
        for batch in _batches([part for part in gathered if not part.unnamed]):
            await self._distribute(await self._queue(batch), batch)
        for batch in _batches([part for part in gathered if part.unnamed]):
            await self._hold(batch)
        return dropped

    async def _hold(self, batch: Sequence["_Part"]) -> None:
        """Queue samples until the description of their device is known. Those beyond ``MAX_HELD`` rows are dropped."""
        if len(self._held) >= MAX_CACHED:
            self._held.clear()
        for part in batch:
            self._held[part.device.id] += 1
            if self._held[part.device.id] == MAX_HELD + 1:
                _log.warning("%s sends telemetry of joints without a description; it is dropped", part.device.id)
        within = [part for part in batch if self._held[part.device.id] <= MAX_HELD]
        if within:
            await self._queue(within)

    async def distribute_backlog(self) -> None:
        """Distribute a part of the rows that terminated processes left in the queue.

        Raises:
            StoreError: The tables are not available.
        """
        self._turn += 1
        now_ms = self._clock.now_ms()
        shard = str(self._turn % SHARDS)
        page = await self._tables.query(records.DATA, shard, last=f"{now_ms - BACKLOG_MS:013d}", limit=_BACKLOG_ROWS)
        for row in page.rows:
            try:
                await self._distribute(row, await self._parts(row))
            except Problem as problem:
                _log.warning("data of %s: %s", row.key, problem.detail)
                if now_ms - int(row.key.partition(":")[0]) > DROP_MS:
                    await self._drop(row)

    async def _queue(self, batch: Sequence["_Part"]) -> Row:
        now_ms = self._clock.now_ms()
        data = {
            "parts": [
                {
                    "device": part.device.id,
                    "pairing": part.device.pairing,
                    "stream": part.stream,
                    "samples": series.pack(part.samples),
                    "unnamed": part.unnamed,
                }
                for part in batch
            ]
        }
        shard = str(now_ms // 1000 % SHARDS)
        return await self._tables.create(records.DATA, Row(shard, f"{now_ms:013d}:{new_id(8)}", data))

    async def _distribute(self, row: Row, batch: Sequence["_Part"]) -> None:
        for device, stream, samples, _ in batch:
            await asyncio.sleep(0)
            new = await self._writer.add(Place(device.id, device.pairing, stream), samples)
            if new:
                await self._notify_observers(device, stream, new)
        await self._drop(row)

    async def _parts(self, row: Row) -> list["_Part"]:
        """The samples in a queue row. Samples of unpaired devices, and of devices without description, are dropped."""
        parts: list[_Part] = []
        for part in row.data["parts"]:
            agent, name = split_device(part["device"]) or ("", "")
            existing = await self._agent(agent)
            device = existing.devices.get(name)
            if device is None or device.pairing != part["pairing"]:
                continue
            samples = series.unpack(part["samples"])
            if part.get("unnamed"):
                if name not in existing.joints:
                    continue
                samples = _named(samples, existing.joints[name])
            parts.append(_Part(device, part["stream"], samples))
        return parts

    async def _notify_observers(self, device: Device, stream: str, new: Samples) -> None:
        means = []
        for _, window in new.windows():
            fields = series.summarize(window).fields
            means.append((window.at_ms[-1], {name: summary.mean for name, summary in fields.items()}))
        for observer in self._observers:
            try:
                await observer(device, stream, means)
            except Exception:  # noqa: BLE001 (an observer must not block the ingest)
                _log.exception("observer of %s of %s", stream, device.id)

    async def _drop(self, row: Row) -> None:
        try:
            await self._tables.delete(records.DATA, row)
        except Conflict:
            _log.debug("%s was distributed twice and stored once", row.key)

    async def _agent(self, agent_id: str) -> _Agent:
        now_ms = self._clock.now_ms()
        existing = self._agents.get(agent_id)
        if existing is not None and 0 <= now_ms - existing.read_ms < CACHE_MS:
            return existing
        if len(self._agents) >= MAX_CACHED:
            self._agents.clear()
        row = await self._tables.get(records.AGENTS, agent_id, "agent") if agent_id else None
        agent = None if row is None else records.read(row, Agent)
        if agent is None or not agent.claimed:
            existing = _Agent(None, {}, {}, now_ms)
        else:
            page = await self._tables.query(records.DESCRIPTIONS, agent_id, limit=1000)
            joints = {row.key: _joints(records.read(row, Description)) for row in page.rows}
            existing = _Agent(agent.space, {device.name: device for device in devices_of(agent)}, joints, now_ms)
        self._agents[agent_id] = existing
        return existing


class _Part(NamedTuple):
    """Samples of one stream of one device. ``unnamed``: the joints have indices instead of names."""

    device: Device
    stream: str
    samples: Samples
    unnamed: bool = False


def _batches(parts: Iterable[_Part]) -> Iterator[list[_Part]]:
    """Groups of parts that fit into one queue row."""
    batch: list[_Part] = []
    free = MAX_ROW_BYTES
    for device, stream, samples, unnamed in parts:
        fields = len(samples.columns)
        step = max(1, MAX_ROW_BYTES * 3 // 4 // (_BYTES_PER_VALUE * (fields + 2)))
        for begin in range(0, len(samples), step):
            piece = samples.part(begin, begin + step)
            size = _BYTES_PER_VALUE * len(piece) * (fields + 2) + sum(len(name) + 4 for name in samples.columns) + 400
            if batch and size > free:
                yield batch
                batch, free = [], MAX_ROW_BYTES
            batch.append(_Part(device, stream, piece, unnamed))
            free -= size
    if batch:
        yield batch


def _joints(description: Description) -> Sequence[str]:
    """Field names of the joints; the index for names that are not valid field names."""
    return [joint.name if _JOINT.match(joint.name) else str(index) for index, joint in enumerate(description.joints)]


def _named(samples: Samples, joints: Sequence[str]) -> Samples:
    """Samples with the names of the joints in place of their indices."""
    return Samples(samples.at_ms, {_renamed(field, joints): values for field, values in samples.columns.items()})


def _renamed(field: str, joints: Sequence[str]) -> str:
    quantity, _, index = field.partition(".")
    return _field(quantity, int(index), joints) if index else field


def _field(quantity: str, index: int, joints: Sequence[str]) -> str:
    return f"{quantity}.{joints[index] if index < len(joints) else index}"


def _sample(message: InboundMessage, joints: Sequence[str]) -> tuple[int, Values]:
    """Time and values of a message.

    Raises:
        ProtocolError: The message does not match its stream.
    """
    values: dict[str, float]
    if message.topic.name == topics.JOINTS:
        telemetry = codec.decode(message.payload, JointTelemetry)
        at_ms, values = telemetry.at_ms, _joint_values(telemetry, joints)
    else:
        measured = codec.decode(message.payload, Measurements)
        at_ms, values = measured.at_ms, {name: float(value) for name, value in measured.values.items()}
    if not 1 <= len(values) <= MAX_FIELDS:
        raise ProtocolError(f"{len(values)} values; it must be 1 to {MAX_FIELDS}")
    if max(values.values()) > MAX_MAGNITUDE or min(values.values()) < -MAX_MAGNITUDE:
        raise ProtocolError(f"a value is beyond {MAX_MAGNITUDE:g}")
    return at_ms, values


def _joint_values(telemetry: JointTelemetry, joints: Sequence[str]) -> dict[str, float]:
    """Position, velocity and effort of each joint; while streaming, also the setpoint age."""
    values: dict[str, float] = {}
    for quantity, measured in (
        ("position_rad", telemetry.position_rad),
        ("velocity_rad_s", telemetry.velocity_rad_s),
        ("effort_nm", telemetry.effort_nm),
    ):
        for index, value in enumerate(measured):
            values[_field(quantity, index, joints)] = value
    if telemetry.mode is Mode.STREAMING:
        values["loop_age_ms"] = telemetry.loop_age_ms
    return values
