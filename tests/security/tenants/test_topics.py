"""Permissions of each role for each topic at real brokers, as listed in ``topics.txt``.

A cell contains ``s`` if the role may subscribe to a channel of Anneliese's device, and ``p`` if it may publish.
"""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pytest

from device_agent.protocol.security.grants import Grant
from function_app.ports.broker_access import Credentials
from tests.fakes.agent import Robot
from tests.fakes.event_grid import event_grid_cloud
from tests.fixtures.brokers import Brokers
from tests.harness.cloud.cloud import Cloud, settings
from tests.harness.network.brokers import BROKERS, BrokerKind, Client, Message, RunningBroker, wait_until
from tests.harness.paths import ROOT

TABLE = Path(__file__).with_name("topics.txt")
RETAINED = ("presence", "description", "twin", "state")


class Stage(NamedTuple):
    """The broker, a client for each role with its issued credentials, and one with all permissions."""

    broker: RunningBroker
    roles: dict[str, dict[str, Any]]
    topics: dict[str, str]
    wildcards: tuple[str, ...]
    observer: Client


def expected() -> dict[str, dict[str, str]]:
    """Channel → role → cell."""
    lines = [line for line in TABLE.read_text().splitlines() if line and not line.startswith("#")]
    columns = [name.strip() for name in lines[0].split("|")[1:]]
    rows = [[part.strip() for part in line.split("|")] for line in lines[1:]]
    return {name: dict(zip(columns, cells, strict=True)) for name, *cells in rows}


def channels() -> dict[str, str]:
    """Channel → address, from the AsyncAPI document. Stop has two: in the name of the owner and of the operator."""
    document = json.loads((ROOT / "docs" / "asyncapi.json").read_text())
    addresses = {name: channel["address"] for name, channel in document["channels"].items()}
    return addresses | {"stop_of_operator": addresses["stop"].replace("{author}", "{operator}")}


@pytest.fixture(params=(*BROKERS, "eventgrid"), scope="module")
def stage(
    request: pytest.FixtureRequest, brokers: Brokers, keys: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Stage]:
    kind: BrokerKind | Literal["eventgrid"] = request.param
    home = tmp_path_factory.mktemp(f"{kind}-home")
    if kind == "eventgrid":
        with event_grid_cloud(home) as (cloud, broker, grid):
            grid.unrestricted_client = "observer"
            with broker.connect("observer", None) as observer:
                yield _stage(broker, cloud, observer)
        return
    shutil.copytree(keys, home / "keys")
    broker = brokers(kind)
    if kind == "mosquitto":
        (home / "mosquitto").mkdir()
        shutil.copy(broker.home / "service.password", home / "mosquitto")
    with Cloud(settings(home, broker)) as cloud, _observer(cloud, broker) as observer:
        yield _stage(broker, cloud, observer)


def _stage(broker: RunningBroker, cloud: Cloud, observer: Client) -> Stage:
    robot, roles, accounts = _people(cloud)
    topics = {name: address.format(**_names(robot), **accounts) for name, address in channels().items()}
    wide = (
        "#",
        "ts/#",
        "+/+/+/+/+/+",
        f"ts/v1/{robot.space}/#",
        f"ts/v1/+/{robot.id}/#",
        "ts/v1/+/+/conn",
        *(f"ts/v1/+/+/+/{kind}" for kind in ("state", "desc", "event", "ack", "cmd", "stored")),
        *(f"ts/v1/+/+/+/{kind}/+" for kind in ("tele", "cam", "ctl", "late", "desc", "stop")),
    )
    return Stage(broker, roles, topics, wide, observer)


def _names(robot: Robot) -> dict[str, str]:
    return {"space": robot.space, "agent": robot.id, "device": "arm", "stream": "x", "camera": "x", "epoch": "1"}


def _people(cloud: Cloud) -> tuple[Robot, dict[str, dict[str, Any]], dict[str, str]]:
    anna, stranger = cloud.sign_in("anna"), cloud.sign_in("stranger")
    robot, foreign = cloud.robot(), cloud.robot()
    robot.pair(anna)
    foreign.pair(stranger)
    people = {"owner": anna, "stranger": stranger}
    for role in ("viewer", "operator"):
        people[role] = cloud.sign_in(role)
        assert anna.post(f"/devices/{robot.device}/shares", {"account": role, "role": role}).status_code == 201
        people[f"space {role}"] = cloud.sign_in(f"space {role}")
        body = {"account": f"space {role}", "role": role}
        assert anna.post(f"/spaces/{robot.space}/shares", body).status_code == 201
    epoch = anna.take_lease(robot.device, wait_ms=0).json()["epoch"]
    steer = {"purpose": "control", "device": robot.device, "epoch": epoch}
    roles = {name: person.post("/mqtt/credentials", {"purpose": "view"}).json() for name, person in people.items()}
    roles["holder"] = anna.post("/mqtt/credentials", steer).json()
    for name, agent in (("agent", robot), ("foreign agent", foreign)):
        roles[name] = agent.request("POST", "/mqtt/credentials", json={"purpose": "agent"}).json()
    assert epoch == 1
    return robot, roles, {"author": anna.account, "operator": people["operator"].account}


def _observer(cloud: Cloud, broker: RunningBroker) -> Client:
    now_s = cloud.clock.now_ms() // 1000
    topics = tuple(address.format_map(_Any()) for address in channels().values())
    grant = Grant(
        principal="service:observer",
        client_id="observer",
        publish=topics,
        subscribe=topics,
        token_id="observer",
        expires_at=now_s + 600,
    )
    credentials = cloud.run(cloud.functions.access.issue(grant))
    observer = broker.connect("observer", credentials)
    assert observer.connected.is_set(), observer.answer
    return observer


class _Any(dict[str, str]):
    def __missing__(self, name: str) -> str:
        return "+"


def join(stage: Stage, role: str, **options: Any) -> Client:
    issued = stage.roles[role]
    return stage.broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]), **options)


def barrier(client: Client, topic: str) -> None:
    """A round trip, after which all earlier messages have arrived."""
    client.paho.unsubscribe(topic)
    client.subscribe(topic)


def test_every_channel_has_a_row_and_every_row_a_channel(stage: Stage) -> None:
    table = expected()
    assert set(table) == set(channels())
    for cells in table.values():
        assert set(cells) == set(stage.roles)
        assert set(cells.values()) <= {"-", "s", "p", "sp"}


def test_no_role_receives_forbidden_topics_by_any_filter(stage: Stage) -> None:
    table, leaks, count = expected(), [], 0
    for name in RETAINED:
        stage.observer.publish_acknowledged(stage.topics[name], f"{name} retained", retain=True)
    for role in stage.roles:
        with join(stage, role) as client:
            assert client.connected.is_set(), f"{role}: {client.answer}"
            for pattern in (*stage.topics.values(), *stage.wildcards):
                client.subscribe(pattern)
            for name, topic in stage.topics.items():
                stage.observer.publish_acknowledged(topic, name)
            client.subscribe(stage.topics["state"])
            received = {message.topic for message in client.pending()}
        for name, topic in stage.topics.items():
            if (topic in received) != ("s" in table[name][role]):
                leaks.append(f"{role} {'receives' if topic in received else 'does not receive'} {name}")
            count += 1
        leaks += [f"{role} receives {topic}" for topic in received - set(stage.topics.values())]
    filters = len(stage.topics) + len(stage.wildcards)
    print(f"{stage.broker.kind}: {count} subscriptions checked, {filters} filters each; {len(leaks)} leaks")  # noqa: T201
    assert not leaks, "\n".join(leaks)


def test_no_role_publishes_to_forbidden_topics(stage: Stage) -> None:
    table, leaks, count = expected(), [], 0
    for topic in stage.topics.values():
        stage.observer.subscribe(topic)
    stage.observer.pending()
    for role in stage.roles:
        for name, topic in stage.topics.items():
            with join(stage, role) as client:
                mid = client.publish(topic, role)
                wait_until(lambda: client.acknowledged(mid) or client.disconnected.is_set(), "a response")  # noqa: B023
            stage.observer.publish_acknowledged(stage.topics["ack"], "mark")
            through = False
            while (message := stage.observer.receive()).payload != b"mark":
                through = through or (message.topic == topic and message.payload == role.encode())
            if through != ("p" in table[name][role]):
                leaks.append(f"{role} {'publishes' if through else 'cannot publish'} {name}")
            count += 1
    print(f"{stage.broker.kind}: {count} publications checked; {len(leaks)} leaks")  # noqa: T201
    assert not leaks, "\n".join(leaks)


def test_no_will_is_published_to_forbidden_topics(stage: Stage) -> None:
    table = expected()
    wills = [
        ("presence", stage.topics["presence"]),
        ("stop", stage.topics["stop"]),
        ("command", stage.topics["command"]),
    ]
    for _, topic in wills:
        stage.observer.subscribe(topic)
    stage.observer.pending()
    for role in stage.roles:
        for name, topic in wills:
            if "p" in table[name][role]:
                continue
            client = join(stage, role, will=Message(topic, b"evil", 1, retain=True))
            if client.connected.is_set():
                client.vanish()
                wait_until(client.disconnected.is_set, "the end of the connection")
            client.close()
    # A message published later arrives after their wills.
    last = join(stage, "agent", will=Message(stage.topics["presence"], b"last", 1, retain=False))
    last.vanish()
    messages = []
    while (message := stage.observer.receive()).payload != b"last":
        messages.append(message)
    last.close()
    assert not [message for message in messages if message.payload == b"evil"]
