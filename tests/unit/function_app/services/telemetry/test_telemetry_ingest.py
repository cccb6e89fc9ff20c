"""Ingested measurements: stored once, for their owner only."""

from typing import Any

import pytest

from device_agent.protocol import Description, Joint, JointTelemetry, Mode, codec, topics
from device_agent.protocol.topics import Topic
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.domain.telemetry import series
from function_app.domain.telemetry.series import Samples
from function_app.services.storage import records
from function_app.services.telemetry.ingest import GIVE_UP_MS, LEFT_MS, SHARDS, InboundMessage, _Part
from tests.harness.crash_injection import Killed
from tests.unit.function_app.services.telemetry.house import AGENT, ANNA, DEVICE, NOW_MS, House, assert_whole, message

pytestmark = pytest.mark.anyio


async def test_measurements_of_claimed_devices_are_stored(house: House) -> None:
    rows = {NOW_MS - 100 * n: {"temperature_c.elbow": 40.0 + n, "fan": 1.0} for n in range(50)}
    arrived = [message(at_ms, "health", **values) for at_ms, values in rows.items()]
    await house.intake.ingest(arrived)
    await house.intake.ingest(arrived[10:20])
    await assert_whole(house, rows)
    for shard in range(SHARDS):
        assert not (await house.tables.query(records.DATA, str(shard))).rows
    (seen,) = house.seen
    assert seen[:2] == (DEVICE, "health")
    assert [set(values) for _, values in seen[2]] == [{"temperature_c.elbow", "fan"}] * len(seen[2])
    assert seen[2][-1][0] == NOW_MS


async def test_joints_are_stored_under_their_names(house: House) -> None:
    names = ("shoulder", "élbow", "wrist")
    limits: dict[str, Any] = {"lower_rad": 0, "upper_rad": 1, "max_effort_nm": 1}
    limits |= {"max_velocity_rad_s": 1, "max_acceleration_rad_s2": 1, "max_jerk_rad_s3": 1}
    joints = tuple(Joint(name=name, label="", **limits) for name in names)
    description = Description(device="arm", kind="arm", robot_type="ur5", label="Arm", joints=joints)
    await records.upsert(house.tables, records.DESCRIPTIONS, AGENT, "arm", lambda _: description, Description)
    telemetry = JointTelemetry(
        tick_ms=1, at_ms=NOW_MS, sequence=1, mode=Mode.STREAMING, position_rad=(0.1, 0.2, 0.3, 0.4),
        velocity_rad_s=(1.0, 2.0, 3.0, 4.0), effort_nm=(5.0,), commanded_rad=(), loop_age_ms=12.0,
    )  # fmt: skip
    await house.intake.ingest(
        [InboundMessage(Topic("space", AGENT, "arm", topics.TELE, "joints"), codec.encode(telemetry))]
    )
    expected = {"loop_age_ms": 12.0, "effort_nm.shoulder": 5.0}
    for index, name in enumerate(("shoulder", "1", "wrist", "3")):
        expected[f"position_rad.{name}"] = (0.1, 0.2, 0.3, 0.4)[index]
        expected[f"velocity_rad_s.{name}"] = index + 1.0
    await assert_whole(house, {NOW_MS: expected}, "joints")


@pytest.mark.parametrize(
    "topic",
    [
        Topic("other", AGENT, "arm", topics.TELE, "health"),
        Topic("space", AGENT, "leg", topics.TELE, "health"),
        Topic("space", "klmnopqrst", "arm", topics.TELE, "health"),
    ],
)
async def test_messages_without_a_claimed_device_are_dropped(house: House, topic: Topic) -> None:
    await house.intake.ingest([InboundMessage(topic, message(NOW_MS, a=1.0).payload)])
    assert await house.reader.streams(ANNA, DEVICE) == []


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
async def test_an_invalid_message_does_not_affect_the_others(house: House, payload: bytes) -> None:
    bad = InboundMessage(Topic("space", AGENT, "arm", topics.TELE, "health"), payload)
    await house.intake.ingest([bad, message(NOW_MS, a=1.0), bad])
    await assert_whole(house, {NOW_MS: {"a": 1.0}})


async def test_queued_samples_are_not_visible_to_the_next_owner(house: House) -> None:
    device = (await house.intake._agent(AGENT)).devices["arm"]
    await house.intake._queue([_Part(device, "health", series.from_rows([(NOW_MS, {"a": 1.0})]))])
    await house.pair(pairing="p2", account="bert")
    house.clock.at_ms += LEFT_MS + 1
    for _ in range(SHARDS):
        await house.intake.distribute_backlog()
    assert await _queued(house) == 0
    assert await house.reader.streams(Identity("bert", "bert", "s2"), DEVICE) == []


async def test_a_failing_observer_does_not_affect_the_ingest(house: House) -> None:
    async def fail(*_: Any) -> None:
        raise RuntimeError("no")

    house.intake._observers = (fail, house.observe)
    await house.intake.ingest([message(NOW_MS, a=1.0)])
    assert len(house.seen) == 1


async def test_a_kill_between_any_two_writes_neither_loses_nor_duplicates_samples(house: House) -> None:
    kills = 0
    for number in range(10):
        stream = f"s{number}"
        rows = {house.clock.at_ms - 3_000 * n: {"a": float(n)} for n in range(10)}
        house.crash.left = number
        try:
            await house.intake.ingest([message(at_ms, stream, **values) for at_ms, values in rows.items()])
        except Killed:
            kills += 1
        house.crash.left = None
        if number == 0:
            continue  # nothing was written at all: the broker, or the caller, has it still
        house.clock.at_ms += LEFT_MS + 1
        _, intake, _, _ = house.instance()
        for _ in range(SHARDS):
            await intake.distribute_backlog()
        assert await _queued(house) == 0
        await assert_whole(house, rows, stream)
    assert kills > 5


async def _queued(house: House) -> int:
    return sum([len((await house.tables.query(records.DATA, str(shard))).rows) for shard in range(SHARDS)])


async def test_samples_that_cannot_be_distributed_are_dropped(house: House) -> None:
    await house.intake.ingest([])
    _, intake, _, _ = house.instance()
    device = (await intake._agent(AGENT)).devices["arm"]
    await intake._queue([_Part(device, "health", series.from_rows([(NOW_MS, {"a": 1.0})]))])

    async def busy(*_: Any) -> Samples:
        raise Problem("busy", 503, "Busy", "Try again.")

    intake._writer.add = busy  # type: ignore[assignment, method-assign]
    for later_ms, left in ((LEFT_MS + 1, 1), (GIVE_UP_MS + 1, 0)):
        house.clock.at_ms = NOW_MS + later_ms
        for _ in range(SHARDS):
            await intake.distribute_backlog()
        assert await _queued(house) == left


async def test_an_unavailable_store_raises_and_the_same_messages_can_be_stored_later(house: House) -> None:
    house.crash.left = 1
    with pytest.raises(Killed):
        await house.intake.ingest([message(NOW_MS, a=1.0)])
    house.crash.left = None
    await house.intake.ingest([message(NOW_MS, a=1.0)])
    await assert_whole(house, {NOW_MS: {"a": 1.0}})
