"""Measurements are stored once, and for the current owner only."""

from typing import Any

import pytest

from device_agent.protocol import Description, Joint, JointTelemetry, Mode, codec, topics
from device_agent.protocol.topics import Topic
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.domain.telemetry import series
from function_app.domain.telemetry.series import Samples
from function_app.services.storage import records
from function_app.services.telemetry.ingest import (
    BACKLOG_MS,
    DROP_MS,
    MAX_HELD,
    SHARDS,
    InboundMessage,
    TelemetryIngest,
    _Part,
)
from tests.harness.crash_injection import Killed
from tests.unit.function_app.services.telemetry.telemetry_fixture import (
    AGENT,
    ANNA,
    DEVICE,
    NOW_MS,
    TelemetrySetup,
    assert_whole,
    message,
)

pytestmark = pytest.mark.anyio


async def test_measurements_of_claimed_devices_are_stored(setup: TelemetrySetup) -> None:
    rows = {NOW_MS - 100 * n: {"temperature_c.elbow": 40.0 + n, "fan": 1.0} for n in range(50)}
    arrived = [message(at_ms, "health", **values) for at_ms, values in rows.items()]
    await setup.ingest.ingest(arrived)
    await setup.ingest.ingest(arrived[10:20])
    await assert_whole(setup, rows)
    for shard in range(SHARDS):
        assert not (await setup.tables.query(records.DATA, str(shard))).rows
    ((device, stream, means),) = setup.observed
    assert (device, stream) == (DEVICE, "health")
    assert [set(values) for _, values in means] == [{"temperature_c.elbow", "fan"}] * len(means)
    assert means[-1][0] == NOW_MS


async def describe(setup: TelemetrySetup, *names: str) -> None:
    """Stores the description of the arm with joints of these names."""
    limits: dict[str, Any] = {"lower_rad": 0, "upper_rad": 1, "max_effort_nm": 1}
    limits |= {"max_velocity_rad_s": 1, "max_acceleration_rad_s2": 1, "max_jerk_rad_s3": 1}
    joints = tuple(Joint(name=name, label="", **limits) for name in names)
    description = Description(device="arm", kind="arm", robot_type="ur5", label="Arm", joints=joints)
    await records.upsert(setup.tables, records.DESCRIPTIONS, AGENT, "arm", lambda _: description, Description)


def joints(at_ms: int = NOW_MS) -> InboundMessage:
    telemetry = JointTelemetry(
        tick_ms=1, at_ms=at_ms, sequence=1, mode=Mode.STREAMING, position_rad=(0.1, 0.2, 0.3, 0.4),
        velocity_rad_s=(1.0, 2.0, 3.0, 4.0), effort_nm=(5.0,), commanded_rad=(), loop_age_ms=12.0,
    )  # fmt: skip
    return InboundMessage(Topic("space", AGENT, "arm", topics.TELE, "joints"), codec.encode(telemetry))


async def distribute_later(setup: TelemetrySetup) -> None:
    """Runs the timer of another process after the samples have waited."""
    setup.clock.at_ms += BACKLOG_MS + 1
    _, ingest, _, _ = setup.instance()
    for _ in range(SHARDS * 2):
        await ingest.distribute_backlog()


@pytest.mark.parametrize("described_first", [True, False])
async def test_joints_are_stored_under_their_names(setup: TelemetrySetup, described_first: bool) -> None:
    if described_first:
        await describe(setup, "shoulder", "élbow", "wrist")
    await setup.ingest.ingest([joints()])
    if not described_first:
        assert await setup.reader.streams(ANNA, DEVICE) == []
        await describe(setup, "shoulder", "élbow", "wrist")
        await distribute_later(setup)
    expected = {"loop_age_ms": 12.0, "effort_nm.shoulder": 5.0}
    for index, name in enumerate(("shoulder", "1", "wrist", "3")):
        expected[f"position_rad.{name}"] = (0.1, 0.2, 0.3, 0.4)[index]
        expected[f"velocity_rad_s.{name}"] = index + 1.0
    await assert_whole(setup, {NOW_MS: expected}, "joints")


async def test_joints_of_a_device_that_never_sends_a_description_are_held_for_a_limited_time(
    setup: TelemetrySetup,
) -> None:
    for number in range(MAX_HELD + 5):
        await setup.ingest.ingest([joints(NOW_MS + number)])
    assert await _queued(setup) == MAX_HELD
    for _ in range(3):  # the timer processes a limited number of rows in a run
        await distribute_later(setup)
    assert await _queued(setup) == 0
    assert await setup.reader.streams(ANNA, DEVICE) == []
    await describe(setup, "shoulder")
    await setup.ingest.ingest([joints()])
    assert [each.name for each in await setup.reader.streams(ANNA, DEVICE)] == ["joints"]


@pytest.mark.parametrize(
    "topic",
    [
        Topic("other", AGENT, "arm", topics.TELE, "health"),
        Topic("space", AGENT, "leg", topics.TELE, "health"),
        Topic("space", "klmnopqrst", "arm", topics.TELE, "health"),
    ],
)
async def test_messages_without_a_claimed_device_are_dropped(setup: TelemetrySetup, topic: Topic) -> None:
    await setup.ingest.ingest([InboundMessage(topic, message(NOW_MS, a=1.0).payload)])
    assert await setup.reader.streams(ANNA, DEVICE) == []


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{}",
        b'{"tick_ms":1,"at_ms":-1,"sequence":1,"values":{"a":1}}',
        *(
            b'{"tick_ms":1,"at_ms":1800000000000,"sequence":1,"values":{%b}}' % values
            for values in (b"", b'"a":NaN', b'"a":1e999', b'"a":1e301', b'"a b":1', b'"a":"1"')
        ),
    ],
)
async def test_an_invalid_message_does_not_affect_the_others(setup: TelemetrySetup, payload: bytes) -> None:
    invalid = InboundMessage(Topic("space", AGENT, "arm", topics.TELE, "health"), payload)
    await setup.ingest.ingest([invalid, message(NOW_MS, a=1.0), invalid])
    await assert_whole(setup, {NOW_MS: {"a": 1.0}})


async def test_queued_samples_are_not_visible_to_the_next_owner(setup: TelemetrySetup) -> None:
    device = (await setup.ingest._agent(AGENT)).devices["arm"]
    await setup.ingest._queue([_Part(device, "health", series.from_rows([(NOW_MS, {"a": 1.0})]))])
    await setup.pair(pairing="p2", account="bert")
    setup.clock.at_ms += BACKLOG_MS + 1
    for _ in range(SHARDS):
        await setup.ingest.distribute_backlog()
    assert await _queued(setup) == 0
    assert await setup.reader.streams(Identity("bert", "bert", "s2"), DEVICE) == []


async def test_a_failing_observer_does_not_affect_the_ingest(setup: TelemetrySetup) -> None:
    async def fail(*_: Any) -> None:
        raise RuntimeError("no")

    setup.ingest._observers = (fail, setup.observe)
    await setup.ingest.ingest([message(NOW_MS, a=1.0)])
    assert len(setup.observed) == 1


async def test_a_kill_between_any_two_writes_neither_loses_nor_duplicates_samples(setup: TelemetrySetup) -> None:
    kills = 0
    for number in range(10):
        stream = f"s{number}"
        rows = {setup.clock.at_ms - 3_000 * n: {"a": float(n)} for n in range(10)}
        setup.crash.left = number
        try:
            await setup.ingest.ingest([message(at_ms, stream, **values) for at_ms, values in rows.items()])
        except Killed:
            kills += 1
        setup.crash.left = None
        if number == 0:
            continue  # nothing was written: the sender delivers the messages again
        setup.clock.at_ms += BACKLOG_MS + 1
        _, ingest, _, _ = setup.instance()
        for _ in range(SHARDS):
            await ingest.distribute_backlog()
        assert await _queued(setup) == 0
        await assert_whole(setup, rows, stream)
    assert kills > 5


async def _queued(setup: TelemetrySetup) -> int:
    return sum([len((await setup.tables.query(records.DATA, str(shard))).rows) for shard in range(SHARDS)])


async def test_samples_that_cannot_be_distributed_are_dropped(setup: TelemetrySetup) -> None:
    await setup.ingest.ingest([])
    _, ingest, _, _ = setup.instance()
    device = (await ingest._agent(AGENT)).devices["arm"]
    await ingest._queue([_Part(device, "health", series.from_rows([(NOW_MS, {"a": 1.0})]))])

    async def busy(*_: Any) -> Samples:
        raise Problem("busy", 503, "Busy", "Try again.")

    ingest._writer.add = busy  # type: ignore[assignment, method-assign]
    for later_ms, left in ((BACKLOG_MS + 1, 1), (DROP_MS + 1, 0)):
        setup.clock.at_ms = NOW_MS + later_ms
        for _ in range(SHARDS):
            await ingest.distribute_backlog()
        assert await _queued(setup) == left


async def test_an_unavailable_store_raises_and_the_same_messages_can_be_stored_later(setup: TelemetrySetup) -> None:
    setup.crash.left = 1
    with pytest.raises(Killed):
        await setup.ingest.ingest([message(NOW_MS, a=1.0)])
    setup.crash.left = None
    await setup.ingest.ingest([message(NOW_MS, a=1.0)])
    await assert_whole(setup, {NOW_MS: {"a": 1.0}})


async def test_a_refused_measurement_is_dropped_with_the_reason_and_others_are_stored(setup: TelemetrySetup) -> None:
    ingest = TelemetryIngest(
        tables=setup.tables,
        writer=setup.writer,
        clock=setup.clock,
        refuse=lambda _, size: "the disk is full" if size > 200 else "",
    )
    large = message(NOW_MS, **{f"field_{number}": 1.0 for number in range(20)})
    assert await ingest.ingest([large, message(NOW_MS + 1, x=1.0)]) == {0: "the disk is full"}
    await assert_whole(setup, {NOW_MS + 1: {"x": 1.0}})
