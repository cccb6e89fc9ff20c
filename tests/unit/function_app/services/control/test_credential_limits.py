"""Broker credentials end with their permission, and fit into one CONNECT."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

import pytest

from device_agent.protocol.security import grants
from device_agent.protocol.security.grants import Grant
from function_app.domain.devices.access import Share
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Role
from function_app.ports.broker_access import Credentials
from function_app.services.control import mqtt_credentials
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.fakes.broker_ports import MemoryBrokerAccess
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.accounts.test_api_keys import make
from tests.unit.function_app.services.sharing.shares import share


def issue(person: Person, purpose: str = "view", **more: Any) -> Any:
    return person.post("/mqtt/credentials", {"purpose": purpose, **more})


def set_milliseconds(cloud: Cloud, part_ms: int) -> None:
    """Advance the clock, so that the next request is at ``part_ms`` within a second."""
    cloud.clock.ahead_ms += 1000 + part_ms - cloud.clock.now_ms() % 1000 - 1


class TestGrants:
    """The grant that the broker gets."""

    def test_a_viewer_is_revoked_with_the_session_or_the_account(
        self, cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker
    ) -> None:
        set_milliseconds(cloud, 500)
        issued = [issue(anna).json() for _ in "12"]
        now_ms = cloud.clock.now_ms()
        first, second = (broker.grants[each["password"]] for each in issued)
        assert first.principal == f"account:{anna.account}:{anna.session}:watch"
        assert re.fullmatch(f"w-{anna.session}-[a-z2-7]{{10}}", first.client_id)
        assert (first.client_id, first.token_id) != (second.client_id, second.token_id)
        assert len(first.token_id) >= 16
        assert second.expires_at == now_ms // 1000 + 900
        assert issued[0]["client_id"] == first.client_id
        assert len(set(issued[0]["subscribe"])) == len(issued[0]["subscribe"])
        assert f"ts/v1/{robot.space}/+/+/stop/{anna.account}" in first.publish

    def test_an_operator_is_revoked_with_the_session_or_the_epoch(
        self, cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker
    ) -> None:
        epoch = anna.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
        issued = [issue(anna, "control", device=robot.device, epoch=epoch).json() for _ in "12"]
        now_ms = cloud.clock.now_ms()
        first, second = (broker.grants[each["password"]] for each in issued)
        assert first.principal == f"account:{anna.account}:{anna.session}"
        assert first.client_id == second.client_id == f"c-{robot.device}-{epoch}"
        assert len(first.token_id) >= 16
        assert first.token_id != second.token_id
        assert second.expires_at == now_ms // 1000 + 600
        assert first.subscribe == ()

    def test_an_agent_gets_its_confirmations(self, robot: Robot, broker: MemoryBroker) -> None:
        issued = robot.request("POST", "/mqtt/credentials", json={"purpose": "agent"}).json()
        assert issued["confirmations"] == grants.agent_confirmations(robot.space, robot.id)
        grant = broker.grants[issued["password"]]
        assert grant == grants.agent_grant(robot.space, robot.id, token_id=grant.token_id, lifetime_s=3600)
        assert len(grant.token_id) >= 16

    def test_expiry_and_lifetime_are_those_of_the_grant(self, anna: Person, robot: Robot, broker: MemoryBroker) -> None:
        epoch = anna.take_lease(robot.device).json()["epoch"]
        for more in ({}, {"purpose": "control", "device": robot.device, "epoch": epoch}):
            issued = issue(anna, **more).json()
            expires_s = broker.grants[issued["password"]].expires_at
            assert issued["server_time_ms"] // 1000 + issued["lifetime_s"] == expires_s

    @pytest.mark.parametrize(("left_ms", "lifetime_s"), [(50_040, 50), (1_900, 1), (500, 1)])
    def test_credentials_end_with_the_share(
        self,
        cloud: Cloud,
        anna: Person,
        bert: Person,
        robot: Robot,
        broker: MemoryBroker,
        *,
        left_ms: int,
        lifetime_s: int,
    ) -> None:
        set_milliseconds(cloud, 600)
        expires_at = share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=120)["expires_at"]
        until_ms = round(1000 * datetime.fromisoformat(expires_at).timestamp())
        assert until_ms % 1000 == 600
        epoch = bert.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
        for more in ({}, {"purpose": "control", "device": robot.device, "epoch": epoch}):
            now_ms = until_ms - left_ms
            cloud.clock.ahead_ms += now_ms - cloud.clock.now_ms() - 1
            issued = issue(bert, **more).json()
            assert cloud.clock.now_ms() == now_ms
            assert issued["lifetime_s"] == lifetime_s
            last_s = now_ms // 1000 + lifetime_s if more else max(now_ms // 1000 + 1, until_ms // 1000)
            assert broker.grants[issued["password"]].expires_at == last_s


class TestEndWhileIssued:
    """The permission ends while the broker creates the credentials."""

    @pytest.fixture
    def meanwhile(self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> Any:
        """Runs a function after the broker has issued credentials, before the response."""

        def install(change: Any) -> None:
            real = cloud.functions.access.issue

            async def issued(grant: Grant) -> Credentials:
                credentials = await real(grant)
                await change()
                return credentials

            monkeypatch.setattr(cloud.functions.access, "issue", issued)

        return install

    @pytest.mark.parametrize("reachable", [True, False])
    @pytest.mark.parametrize("purpose", ["view", "control"])
    def test_credentials_of_a_revoked_key_are_revoked(
        self,
        cloud: Cloud,
        anna: Person,
        robot: Robot,
        broker: MemoryBroker,
        meanwhile: Any,
        *,
        purpose: str,
        reachable: bool,
    ) -> None:
        key, program = make(anna)
        epoch = program.take_lease(robot.device).json()["epoch"]
        before = set(broker.grants)

        async def end() -> None:
            await records.remove(cloud.functions.tables, records.API_KEYS, key, "key")
            broker.reachable = reachable

        meanwhile(end)
        more = {"device": robot.device, "epoch": epoch} if purpose == "control" else {}
        answer = issue(program, purpose, **more)
        if reachable:
            assert "API key" in problem(answer, 403, "forbidden")["detail"]
            assert set(broker.grants) == before
        else:
            problem(answer, 503, "broker-unavailable")

    @pytest.mark.parametrize(
        "change",
        [
            lambda shared: replace(shared, role=Role.OPERATOR),
            lambda shared: replace(shared, expires_ms=shared.created_ms + 600_000),
            lambda shared: replace(shared, owner="other"),
        ],
        ids=["role", "expiry", "owner"],
    )
    def test_viewing_credentials_of_a_changed_share_are_revoked(  # noqa: PLR0917 (fixtures and parameters)
        self,
        cloud: Cloud,
        anna: Person,
        bert: Person,
        robot: Robot,
        broker: MemoryBroker,
        meanwhile: Any,
        *,
        change: Callable[[Share], Share],
    ) -> None:
        share(anna, f"devices/{robot.device}", bert, "viewer")
        place = records.SHARES, f"device:{robot.device}", f"account:{bert.account}"
        before = set(broker.grants)

        async def end() -> None:
            row, shared = await records.find(cloud.functions.tables, *place, Share)
            assert row is not None
            assert shared is not None
            await records.update(cloud.functions.tables, records.SHARES, row, change(shared))

        meanwhile(end)
        problem(issue(bert), 503, "busy")
        assert set(broker.grants) == before

    @pytest.mark.parametrize("purpose", ["view", "control", "agent"])
    def test_without_a_broker_there_are_no_credentials(
        self, anna: Person, robot: Robot, broker: MemoryBroker, purpose: str
    ) -> None:
        epoch = anna.take_lease(robot.device).json()["epoch"]
        broker.reachable = False
        more = {"device": robot.device, "epoch": epoch} if purpose == "control" else {}
        if purpose == "agent":
            answer = robot.request("POST", "/mqtt/credentials", json={"purpose": "agent"})
        else:
            answer = issue(anna, purpose, **more)
        assert "cannot be reached" in problem(answer, 503, "broker-unavailable")["detail"]


def device(name: str, space: str = "room", *, role: Role = Role.OPERATOR, space_role: Role | None = None) -> Device:
    topic = f"ts/v1/{space}/lab/{name}"
    return Device(
        f"lab-{name}", name, "", "arm", "ur5", "lab", space, "p", role, topic, owner="a", space_role=space_role
    )


def member(name: str, role: Role, space_role: Role, space: str = "room") -> Device:
    """A device in a shared space."""
    return device(name, space, role=role, space_role=space_role)


def size_of(devices: Sequence[Device]) -> int:
    """Size of the filters for single devices [bytes]."""
    filters = {f"{each.topic}/stop/bert" for each in devices}
    filters |= {topic for each in devices for topic in grants.device_subscriptions("room", "lab", each.name)}
    return sum(len(pattern) + 3 for pattern in filters)


class TestViewFilters:
    """The filters of one viewing connection."""

    access = MemoryBrokerAccess(MemoryBroker())

    def filters(self, *devices: Device) -> mqtt_credentials._ViewFilters:
        return mqtt_credentials._view_filters(list(devices), self.access, author="bert")

    def test_a_shared_space_needs_the_same_filters_for_any_number_of_devices(self) -> None:
        devices = [member(name, Role.OPERATOR, Role.OPERATOR) for name in ("left", "right")]
        result = self.filters(*devices)
        assert result.publish == ["ts/v1/room/+/+/stop/bert"]
        assert result.subscribe == list(grants.device_subscriptions("room", "+", "+"))
        assert result.devices == devices
        assert result.stops == [f"{each.topic}/stop/bert" for each in devices]

    def test_spaces_are_listed_one_after_another(self) -> None:
        hall = member("left", Role.OPERATOR, Role.OPERATOR, "hall")
        lab = device("right", "lab", space_role=Role.OPERATOR)
        room = member("viewed", Role.VIEWER, Role.VIEWER)
        result = self.filters(room, lab, hall)
        assert result.devices == [hall, lab, room]
        assert result.publish == ["ts/v1/hall/+/+/stop/bert", "ts/v1/lab/+/+/stop/bert"]
        assert result.stops == [f"{hall.topic}/stop/bert", f"{lab.topic}/stop/bert"]
        expected = [
            topic for space in ("hall", "lab", "room") for topic in grants.device_subscriptions(space, "+", "+")
        ]
        assert result.subscribe == expected

    def test_a_device_of_a_viewed_space_is_stopped_by_its_own_share(self) -> None:
        devices = [member("left", Role.VIEWER, Role.VIEWER), member("right", Role.OPERATOR, Role.VIEWER)]
        result = self.filters(*devices)
        assert result.publish == result.stops == ["ts/v1/room/lab/right/stop/bert"]
        assert result.subscribe == list(grants.device_subscriptions("room", "+", "+"))
        assert result.devices == devices, "each device once"

    def test_single_devices_are_listed_after_whole_spaces(self) -> None:
        single, viewed = device("single"), device("viewed", role=Role.VIEWER)
        shared = member("shared", Role.OPERATOR, Role.OPERATOR, "hall")
        result = self.filters(single, viewed, shared)
        assert result.devices == [shared, single, viewed]
        assert result.publish == ["ts/v1/hall/+/+/stop/bert", "ts/v1/room/lab/single/stop/bert"]
        assert result.stops == [f"{shared.topic}/stop/bert", f"{single.topic}/stop/bert"]
        expected = [
            *grants.device_subscriptions("hall", "+", "+"),
            *grants.device_subscriptions("room", "lab", "single"),
            *grants.device_subscriptions("room", "lab", "viewed"),
        ]
        assert result.subscribe == list(dict.fromkeys(expected))

    def test_a_device_shared_in_two_ways_in_a_space_of_another_device_is_covered_once(self) -> None:
        shared = member("shared", Role.OPERATOR, Role.OPERATOR)
        single = device("single")
        result = self.filters(shared, single)
        assert result.devices == [shared, single]
        assert len(result.subscribe) == len(set(result.subscribe))

    @pytest.mark.parametrize(("spare", "count"), [(0, 2), (-1, 1)])
    def test_the_devices_that_fit_are_covered(self, monkeypatch: pytest.MonkeyPatch, spare: int, count: int) -> None:
        devices = [device(name) for name in ("one", "two", "three")]
        monkeypatch.setattr(mqtt_credentials, "TOPIC_BYTES", size_of(devices[:2]) + spare)
        result = self.filters(*devices)
        assert result.devices == devices[:count]
        assert result.stops == result.publish == [f"{each.topic}/stop/bert" for each in devices[:count]]

    def test_the_spaces_that_fit_are_covered(self, monkeypatch: pytest.MonkeyPatch) -> None:
        shared = [member(name, Role.OPERATOR, Role.OPERATOR, name) for name in ("hall", "room")]
        size = sum(len(topic) + 3 for topic in grants.device_subscriptions("hall", "+", "+"))
        monkeypatch.setattr(mqtt_credentials, "TOPIC_BYTES", size + len("ts/v1/hall/+/+/stop/bert") + 3)
        result = self.filters(*shared)
        assert (result.devices, result.publish) == (shared[:1], ["ts/v1/hall/+/+/stop/bert"])

    def test_filters_that_the_broker_does_not_accept_are_left_out(self, monkeypatch: pytest.MonkeyPatch) -> None:
        seen = []

        def accepts(publish: Sequence[str], subscribe: Sequence[str]) -> bool:
            seen.append((list(publish), list(subscribe)))
            return len(publish) < 2

        monkeypatch.setattr(self.access, "accepts", accepts)
        first, second = device("one"), device("two")
        result = self.filters(first, second)
        assert result.devices == [first]
        assert seen[0] == (result.publish, result.subscribe)
        assert [topic.split("/")[4] for topic in seen[1][0]] == ["one", "two"]
        assert set(seen[1][1]) > set(seen[0][1])
