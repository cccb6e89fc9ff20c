"""Every route of an owned resource and every topic, for every role: generated from the API documents.

A new route or channel fails until this file lists the permitted roles.
"""

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

from device_agent.protocol.documents import asyncapi
from function_app.ports.broker_access import Credentials
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker, MemoryConnection
from tests.harness.cloud.cloud import MOVE, Cloud, Person, paired
from tests.harness.network.brokers import Message, wait_until

NAMED = {"device", "agent", "action", "space"}
"""Path parameters that name an owned resource."""
SEEING = {
    "get_device", "get_lease", "list_actions", "get_action", "list_events", "list_faults",
    "get_latency", "list_uploads", "get_upload", "get_diagnostics", "list_space_diagnostics", "get_control_request",
    "get_device_robot_type", "get_device_robot_type_file", "list_streams", "read_stream", "add_viewer",
    "remove_viewer",
}  # fmt: skip
OPERATING = {
    "take_lease", "release_lease", "request_control", "accept_control_request", "reject_control_request",
    "withdraw_control_request", "start_action", "cancel_action", "stop_device", "stop_space", "reset_stop",
    "acknowledge_fault", "add_latency", "begin_upload", "complete_upload", "list_device_movements",
    "get_device_movement",
}  # fmt: skip
OWNING = {
    "list_device_shares", "share_device", "unshare_device", "list_space_shares", "share_space", "unshare_space",
    "list_device_invitations", "invite_to_device", "withdraw_device_invitation",
    "list_space_invitations", "invite_to_space", "withdraw_space_invitation", "list_space_transfers", "transfer_space",
    "withdraw_space_transfer", "delete_upload", "rename_device",
}  # fmt: skip
OWN = {"unpair_agent", "move_agent", "list_agent_transfers", "transfer_agent", "withdraw_agent_transfer"}
"""About agents, which do not exist for anybody but their owner."""
BODIES: dict[str, Any] = {
    "take_lease": {},
    "request_control": {},
    "start_action": {"request": MOVE},
    "stop_device": {},
    "stop_space": {},
    "add_latency": {"transport": "http", "path": "device-cloud", "samples": [{"at_ms": 1, "ms": 1}]},
    "begin_upload": {"stream": "camera", "length": 3, "content_type": "image/png"},
    "rename_device": {"label": "x"},
    "move_agent": {"space": "x"},
    "share_device": {"account": "dora", "role": "viewer"},
    "share_space": {"account": "dora", "role": "viewer"},
    "invite_to_device": {"role": "viewer"},
    "invite_to_space": {"role": "viewer"},
    "transfer_agent": {},
    "transfer_space": {},
}
REFUSED = {401, 403, 404}
CHANNELS = {name: channel["address"] for name, channel in asyncapi.document()["channels"].items()}
HEARD = {"presence", "description", "twin", "state", "joints", "measurements", "camera", "event", "ack"}
"""By every account that may see the device."""
UNHEARD = {"late_joints", "late_measurements", "command", "setpoint", "stop"}


class House(NamedTuple):
    """Anna's robot, and people with every part in it; ``bert`` has none, but a robot of his own."""

    anna: Person
    robot: Robot
    people: dict[str, Person]
    other: Robot


@pytest.fixture
def house(cloud: Cloud, pair: tuple[Person, Robot]) -> Iterator[House]:
    anna, robot = pair
    people = {"viewer": cloud.sign_in("vera"), "operator": cloud.sign_in("oleg"), "stranger": cloud.sign_in("bert")}
    cloud.sign_in("dora")
    for role in ("viewer", "operator"):
        body = {"account": people[role].name, "role": role}
        assert anna.post(f"/spaces/{robot.space}/shares", body).status_code == 201
    with paired(cloud, "bert") as (_, other):
        yield House(anna, robot, people, other)


# ------------------------------------------------------------ routes


def ids(house: House) -> dict[str, str]:
    anna, robot = house.anna, house.robot
    epoch = anna.take(robot.device, lease_ms=600_000).json()["epoch"]
    assert epoch == 1
    action = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
    again = anna.cloud.sign_in("anna")
    capture = {"stream": "camera", "length": 3, "content_type": "image/png"}
    at = f"/devices/{robot.device}"
    return {
        "device": robot.device,
        "space": robot.space,
        "agent": robot.id,
        "action": action,
        "account": house.people["viewer"].account,
        "request_id": again.post(f"{at}/lease/requests", {}).json()["request"]["id"],
        "upload": anna.post(f"{at}/uploads", capture).json()["id"],
        "invitation": anna.post(f"{at}/invitations", {"role": "viewer"}).json()["id"],
        "name": "wave",
        "stream": "joints",
        "fault": "hot",
    }


def lowest(name: str) -> str:
    found = [role for role, names in (("viewer", SEEING), ("operator", OPERATING), ("owner", OWNING), ("own", OWN))
             if name in names]  # fmt: skip
    assert len(found) == 1, f"who may {name}? say so in this file"
    return found[0]


def test_every_route_answers_each_role_as_it_may(cloud: Cloud, house: House) -> None:
    known = ids(house)
    asked = 0
    for path, operations in cloud.app.openapi()["paths"].items():
        if not set(re.findall(r"{(\w+)}", path)) & NAMED:
            continue
        for method, operation in operations.items():
            if operation["security"] == [{"agentToken": []}]:
                continue
            name = operation["operationId"]
            where = path.format(**known).removeprefix("/api/v1") + ("?epoch=1" if name == "release_lease" else "")
            needed = lowest(name)
            for role in ("stranger", "viewer", "operator"):
                answer = house.people[role].ask(method.upper(), where, json=BODIES.get(name))
                told = f"{name} as {role}: {answer.status_code} {answer.text}"
                if role == "stranger" or needed == "own":
                    assert answer.status_code == 404, told
                elif needed == "owner" or (needed, role) == ("operator", "viewer"):
                    # Who is shared with may give that back; everything else of an owner's is forbidden.
                    gives_back = name == "unshare_space" and role == "viewer"
                    gives_back = gives_back or (name == "unshare_device" and role == "viewer")
                    assert gives_back or answer.status_code == 403, told
                elif answer.status_code in REFUSED:
                    # Allowed, and there is no such thing, or it is not theirs to answer: never for want of a role.
                    code = answer.json()["type"].rpartition("/")[2]
                    assert code == "forbidden" or code.removesuffix("-unknown") not in {code, *NAMED}, told
                    assert code != "forbidden" or "Only the session" in answer.text, told
                asked += 1
            if name.startswith("unshare_"):
                body = {"account": "vera", "role": "viewer"}
                assert house.anna.post(f"/spaces/{house.robot.space}/shares", body).status_code in {200, 201}
    assert asked > 100


def test_a_part_in_one_device_is_none_in_its_space(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    anna, robot = pair
    oleg = cloud.sign_in("oleg")
    assert anna.post(f"/devices/{robot.device}/shares", {"account": "oleg", "role": "operator"}).status_code == 201
    known = {"space": robot.space, "account": anna.account, "invitation": "x"}
    for path, operations in cloud.app.openapi()["paths"].items():
        if "{space}" not in path:
            continue
        for method, operation in operations.items():
            body = BODIES.get(operation["operationId"])
            answer = oleg.ask(method.upper(), path.format(**known).removeprefix("/api/v1"), json=body)
            assert answer.status_code == 404, f"{operation['operationId']}: {answer.text}"


# ------------------------------------------------------------ topics


def test_of_every_channel_is_said_who_may_hear_it() -> None:
    assert set(CHANNELS) == HEARD | UNHEARD
    assert not HEARD & UNHEARD


def places(robot: Robot, epoch: int) -> dict[str, str]:
    """Channel → its topic for Anna's robot."""
    levels = {"{space}": robot.space, "{agent}": robot.id, "{device}": robot.names[0], "{epoch}": str(epoch),
              "{stream}": "health", "{camera}": "front"}  # fmt: skip
    found = {}
    for name, address in CHANNELS.items():
        for level, text in levels.items():
            address = address.replace(level, text)  # noqa: PLW2901 (level by level)
        assert "{" not in address
        found[name] = address
    return found


def wider(topic: str) -> set[str]:
    """Filters that cover a topic and more."""
    levels = topic.split("/")
    one = {"/".join((*levels[:place], "+", *levels[place + 1 :])) for place in range(len(levels))}
    return one | {"/".join((*levels[:place], "#")) for place in range(len(levels))} | {"/".join("+" for _ in levels)}


class Principal(NamedTuple):
    """One connection's credentials, and what it may."""

    issued: dict[str, Any]
    hears: set[str]
    says: set[str]

    def open(self, broker: MemoryBroker, **options: Any) -> MemoryConnection:
        credentials = Credentials(self.issued["username"], self.issued["password"])
        client = broker.connect(self.issued["client_id"], credentials, **options)
        assert client.connected.is_set(), client.answer
        return client


def principals(house: House, by: str) -> dict[str, Principal]:
    """Everybody's connections, with parts by ``device`` or by ``space``."""
    anna, robot, people, _ = house
    if by == "device":
        for role in ("viewer", "operator"):
            anna.delete(f"/spaces/{robot.space}/shares/{people[role].account}")
            anna.post(f"/devices/{robot.device}/shares", {"account": people[role].name, "role": role})
    epoch = people["operator"].take(robot.device, lease_ms=600_000).json()["epoch"]
    steer = {"purpose": "control", "device": robot.device, "epoch": epoch}

    def issued(person: Person, body: Any) -> dict[str, Any]:
        answer: dict[str, Any] = person.post("/mqtt/credentials", body).json()
        return answer

    watch = {"purpose": "view"}
    return {
        "stranger": Principal(issued(people["stranger"], watch), set(), set()),
        "viewer": Principal(issued(people["viewer"], watch), HEARD, set()),
        "operator": Principal(issued(people["operator"], watch), HEARD, {"stop"}),
        "holder": Principal(issued(people["operator"], steer), set(), {"setpoint"}),
        "owner": Principal(issued(anna, watch), HEARD, {"stop"}),
        "another agent": Principal(house.other.ask("POST", "/mqtt/credentials", json={"purpose": "agent"}).json(),
                                   set(), set()),
    }  # fmt: skip


@pytest.mark.parametrize("by", ["device", "space"])
def test_every_topic_is_said_and_heard_by_whom_it_may(
    cloud: Cloud, broker: MemoryBroker, house: House, by: str
) -> None:
    everybody = principals(house, by)
    topic = places(house.robot, 1)
    for robot in (house.robot, house.other):
        assert robot.link is not None
        robot.link.close()  # what is said here are no messages
    mark = f"mark/{house.robot.space}"
    grant = broker.grant(f"ear-{house.robot.id}", publish=(mark,), subscribe=("ts/v1/#", mark))
    with broker.connect(grant.client_id, cloud.run(cloud.functions.access.issue(grant))) as ear:
        assert ear.subscribe(*topic.values(), mark) == [1] * (len(topic) + 1)
        ear.publish_acknowledged(mark, b"begin")
        while ear.receive().topic != mark:
            pass  # what is retained
        for role, principal in everybody.items():
            if role != "another agent":
                hear(broker, principal, topic, role, house.robot.space, by)
            say(broker, principal, topic, role)
            will(broker, principal, topic["command"])
        ear.publish_acknowledged(mark, b"end")
        heard = []
        while (message := ear.receive()).topic != mark:
            heard.append((message.payload.decode(), message.topic))
    allowed = [(role, topic[name]) for role, each in everybody.items() for name in each.says]
    assert sorted(heard) == sorted(allowed)


def hear(broker: MemoryBroker, principal: Principal, topic: dict[str, str], role: str, space: str, by: str) -> None:  # noqa: PLR0917
    with principal.open(broker) as client:
        for name, each in topic.items():
            assert (client.subscribe(each) == [1]) == (name in principal.hears), f"{role} hears {name}"
        granted = set(principal.issued["subscribe"])
        whole = role == "owner" or (by == "space" and principal.hears)
        for each in sorted({pattern for name in topic for pattern in wider(topic[name])}):
            inside = whole and each.startswith(f"ts/v1/{space}/") and "#" not in each and _watched(each)
            if not inside and each not in granted:
                assert client.subscribe(each) == [128], f"{role} hears {each}"
        if not principal.hears:
            assert client.pending() == [], "nothing that is retained either"


def _watched(pattern: str) -> bool:
    """Whether a filter of a whole space stays with what is watched: its kind is named."""
    levels = pattern.split("/")
    kind = "/".join(levels[5:6])
    return len(levels) == 5 or kind in {"desc", "state", "tele", "cam", "event", "ack"}


def say(broker: MemoryBroker, principal: Principal, topic: dict[str, str], role: str) -> None:
    client = principal.open(broker)
    for name in sorted(topic):
        mid = client.publish(topic[name], role.encode())
        wait_until(lambda client=client, mid=mid: client.disconnected.is_set() or client.acknowledged(mid), "an answer")  # type: ignore[misc]
        if client.disconnected.is_set():
            client.close()
            client = principal.open(broker)
    client.close()


def will(broker: MemoryBroker, principal: Principal, topic: str) -> None:
    """A will where nothing may be said: whether it is refused at once or never said is the broker's."""
    credentials = Credentials(principal.issued["username"], principal.issued["password"])
    client = broker.connect(principal.issued["client_id"], credentials, will=Message(topic, b"will", 1, retain=True))
    if client.connected.is_set():
        client.vanish()
        wait_until(client.disconnected.is_set, "the end of the connection")
    client.close()
