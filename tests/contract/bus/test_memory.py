"""The command bus and the feeds of ``MemoryBroker``, which the unit tests of the services use."""

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator, Awaitable, Sequence

import pytest

from device_agent.protocol.security.grants import Grant
from function_app.domain.common.problems import Problem
from function_app.ports.broker_access import BrokerAccessError, Credentials
from function_app.ports.tables import StoreError
from tests.contract.bus.suite import BusContract, Heard, Stage
from tests.fakes.broker import MemoryBroker, MemoryConnection
from tests.fakes.broker_ports import MemoryBrokerAccess, MemoryCommandBus, MemoryFeed, MemoryTelemetry
from tests.harness.network.brokers import Message

SPACE = "ts/v1/space"
STATE = f"{SPACE}/agent/arm/state"

pytestmark = pytest.mark.anyio


class TestMemoryBus(BusContract):
    @pytest.fixture
    def stage(self) -> Stage:
        broker, away = MemoryBroker(), MemoryBroker()
        away.reachable = False
        received: list[Heard] = []

        class Listener:
            def matches(self, topic: str) -> bool:
                return topic.startswith(SPACE)

            def deliver(self, message: Message) -> None:
                received.append(Heard(message.topic, message.payload))

        broker.attach(Listener())

        def retained(topic: str) -> bytes | None:
            return next((message.payload for message in broker.retained(topic)), None)

        return Stage(MemoryCommandBus(broker), "space", lambda: received, retained, MemoryCommandBus(away))


class TestMemoryBrokerAccess:
    @pytest.fixture
    def now_s(self) -> list[float]:
        return [1000.0]

    @pytest.fixture
    def broker(self, now_s: list[float]) -> MemoryBroker:
        return MemoryBroker(now_s=lambda: now_s[0])

    async def connect(self, broker: MemoryBroker, client_id: str = "viewer") -> MemoryConnection:
        grant = Grant(
            principal=f"account:{client_id}",
            client_id=client_id,
            publish=(f"{SPACE}/+/+/ctl/+",),
            subscribe=(f"{SPACE}/#",),
            token_id=secrets.token_hex(8),
            expires_at=1300,
        )
        return MemoryConnection(broker, client_id, await MemoryBrokerAccess(broker).issue(grant)).open()

    async def test_a_connection_may_do_what_its_grant_says_and_no_more(self, broker: MemoryBroker) -> None:
        viewer, other = await self.connect(broker), await self.connect(broker, "other")
        assert viewer.subscribe(f"{SPACE}/+/+/state", "ts/v1/elsewhere/#", "#") == [1, 128, 128]
        other.subscribe(f"{SPACE}/#")
        viewer.publish(f"{SPACE}/agent/arm/ctl/1", b"setpoint")
        viewer.publish(f"{SPACE}/agent/arm/cmd", b"forbidden")
        assert [message.payload for message in other.pending()] == [b"setpoint"]
        assert viewer.pending() == []

    async def test_wrong_credentials_and_a_foreign_client_id_are_refused(self, broker: MemoryBroker) -> None:
        credentials = (await self.connect(broker))._credentials
        for client_id, given in (("x", credentials), ("viewer", None), ("viewer", Credentials("account:viewer", "?"))):
            assert not MemoryConnection(broker, client_id, given).open().connected.is_set()

    async def test_a_subscriber_receives_retained_messages_once(self, broker: MemoryBroker) -> None:
        broker.publish(STATE, b"old", retain=True)
        broker.publish(STATE, b"new", retain=True)
        viewer = await self.connect(broker)
        viewer.subscribe(f"{SPACE}/+/+/state")
        assert [(message.payload, message.retain) for message in viewer.pending()] == [(b"new", True)]

    async def test_a_second_connection_with_a_client_id_replaces_the_first(self, broker: MemoryBroker) -> None:
        first, second = await self.connect(broker), await self.connect(broker)
        assert first.disconnected.is_set()
        assert not second.disconnected.is_set()

    @pytest.mark.parametrize(
        "revoked", [{"client_id": "viewer"}, {"principal": "account:viewer"}, {"principal": "account"}]
    )
    async def test_a_revocation_ends_connections_and_credentials(
        self, broker: MemoryBroker, revoked: dict[str, str]
    ) -> None:
        access, viewer = MemoryBrokerAccess(broker), await self.connect(broker)
        viewer.will = Message(f"{SPACE}/agent/conn", b"gone", 1, retain=True)
        await access.revoke(**revoked)
        assert viewer.disconnected.is_set()
        assert not MemoryConnection(broker, "viewer", viewer._credentials).open().connected.is_set()
        assert [message.payload for message in broker.retained(f"{SPACE}/agent/conn")] == [b"gone"]
        assert (await self.connect(broker)).connected.is_set()

    async def test_credentials_expire_by_the_clock_of_the_broker(
        self, broker: MemoryBroker, now_s: list[float]
    ) -> None:
        access, viewer = MemoryBrokerAccess(broker), await self.connect(broker)
        await access.expire(now_s[0])
        assert not viewer.disconnected.is_set()
        now_s[0] = 1300
        await access.expire(now_s[0])
        assert viewer.disconnected.is_set()

    async def test_an_unreachable_broker_is_an_error(self, broker: MemoryBroker) -> None:
        broker.reachable = False
        with pytest.raises(BrokerAccessError):
            await MemoryBrokerAccess(broker).revoke(client_id="viewer")
        with pytest.raises(BrokerAccessError):
            await self.connect(broker)

    async def test_revoke_takes_exactly_one_name(self, broker: MemoryBroker) -> None:
        for names in ({}, {"client_id": "a", "principal": "b"}):
            with pytest.raises(ValueError, match="exactly one"):
                await MemoryBrokerAccess(broker).revoke(**names)


@pytest.fixture
def no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fakes.broker_ports.RETRY_S", 0)


class TestMemoryFeeds:
    async def test_messages_of_a_topic_are_stored_in_order_and_the_broker_is_idle_afterwards(self) -> None:
        broker, stored = MemoryBroker(), []

        async def handle(topic: str, payload: bytes) -> None:
            await asyncio.sleep(0)
            stored.append((topic, payload))

        broker.publish(STATE, b"retained", retain=True)
        async with running(MemoryFeed(broker).run(handle)):
            for payload in (b"1", b"2"):
                broker.publish(STATE, payload)
            broker.publish(f"{SPACE}/agent/arm/cmd", b"not for the cloud")
            await broker.idle()
        assert stored == [(STATE, payload) for payload in (b"retained", b"1", b"2")]

    @pytest.mark.usefixtures("no_pause")
    async def test_a_message_that_cannot_be_stored_is_tried_again_and_then_dropped(self) -> None:
        broker, tried = MemoryBroker(), []

        async def handle(_: str, payload: bytes) -> None:
            tried.append(payload)
            if payload == b"fails":
                raise ZeroDivisionError
            if payload == b"busy" or tried.count(payload) < 3:
                raise Problem("busy", 503, "Busy", "Try again.") if payload == b"busy" else StoreError("away")

        async with running(MemoryFeed(broker).run(handle)):
            for payload in (b"busy", b"fails", b"good"):
                broker.publish(STATE, payload)
            await broker.idle()
        assert tried == [*[b"busy"] * 6, b"fails", *[b"good"] * 3]

    @pytest.mark.parametrize(("late", "kind"), [(False, "tele"), (True, "late")])
    async def test_measurements_arrive_in_batches(self, late: bool, kind: str) -> None:
        broker, batches = MemoryBroker(), []

        async def handle(batch: Sequence[tuple[str, bytes]]) -> None:
            batches.append([payload for _, payload in batch])

        async with running(MemoryTelemetry(broker, late=late).run(handle)):
            for name in ("tele", "late"):
                for number in range(3):
                    broker.publish(f"{SPACE}/agent/arm/{name}/joints", f"{name}{number}".encode())
            await broker.idle()
        assert [payload for batch in batches for payload in batch] == [f"{kind}{n}".encode() for n in range(3)]


@contextlib.asynccontextmanager
async def running(feed: Awaitable[None]) -> AsyncIterator[None]:
    task = asyncio.ensure_future(feed)
    await asyncio.sleep(0)
    yield
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
