"""Topic spaces of Event Grid for grants, evaluated by a fake that follows Microsoft's pages."""

import json
import re
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.protocol.security import grants
from device_agent.protocol.security.grants import Grant, agent_grant
from function_app.adapters.azure import topic_spaces
from function_app.ports.broker_access import BrokerAccessError
from infra.azure import __main__ as infra_azure
from tests.fakes.event_grid import Client, Namespace, covers

NAMESPACE = Namespace(infra_azure.template())
AGENT = agent_grant("space", "agentaaaaa", token_id="t", lifetime_s=3600)


def person(publish: tuple[str, ...] = (), subscribe: tuple[str, ...] = ()) -> Grant:
    return Grant(
        principal="account:a:s:watch", client_id="w", publish=publish, subscribe=subscribe, token_id="t", expires_at=1
    )


def watching(*devices: str, spaces: tuple[str, ...] = (), stops: tuple[str, ...] = ()) -> Grant:
    subscribe = [topic for space in spaces for topic in grants.device_subscriptions(space, "+", "+")]
    subscribe += [topic for name in devices for topic in grants.device_subscriptions("room", "agentaaaaa", name)]
    publish = [f"ts/v1/{space}/+/+/stop/account" for space in spaces]
    publish += [f"ts/v1/room/agentaaaaa/{name}/stop/account" for name in stops]
    return person(tuple(publish), tuple(dict.fromkeys(subscribe)))


HOLDER = person(("ts/v1/space/agentaaaaa/arm/ctl/7",))
GRANTS = [
    AGENT,
    HOLDER,
    person(),
    watching("arm"),
    watching("arm", "lamp", stops=("arm",)),
    watching(spaces=("space",)),
    watching("arm", "lamp", "door", "pir", spaces=("space", "other", "third"), stops=("a", "b", "c", "d", "e", "f")),
]


def client(grant: Grant) -> Client:
    return Client(grant.client_id, topic_spaces.attributes(grant))


def may_publish(grant: Grant, topic: str) -> bool:
    return NAMESPACE.may(client(grant), "Publisher", topic)


def may_subscribe(grant: Grant, pattern: str) -> bool:
    return NAMESPACE.may(client(grant), "Subscriber", pattern)


LEVEL = st.sampled_from(
    ["space", "other", "room", "agentaaaaa", "agentbbbbb", "arm", "lamp", "conn", "state", "cmd", "ctl", "stop"]
)
ANY_LEVEL = LEVEL | st.sampled_from(["tele", "desc", "twin", "x", "7", "8", "+", "#"])
PATTERN = st.one_of(
    st.lists(ANY_LEVEL, min_size=1, max_size=6).map(lambda levels: "/".join(["ts", "v1", *levels])),
    st.sampled_from(sorted({each for grant in GRANTS for each in (*grant.publish, *grant.subscribe)})),
    st.sampled_from(["#", "+/+/#", "ts/#", "$SYS/#", "ts/v1/#", "ts/v1/+/+/+/stop/+", "ts/v1/+/+/+/ctl/+"]),
)


@given(st.sampled_from(GRANTS), PATTERN)
def test_the_namespace_allows_exactly_what_the_grant_does(grant: Grant, pattern: str) -> None:
    assert may_subscribe(grant, pattern) == grant.may_subscribe(pattern)
    if "+" not in pattern and "#" not in pattern:
        assert may_publish(grant, pattern) == grant.may_publish(pattern)


def test_every_topic_of_a_grant_is_allowed() -> None:
    for grant in GRANTS:
        assert all(may_subscribe(grant, pattern) for pattern in grant.subscribe)
        assert all(may_publish(grant, pattern.replace("+", "x")) for pattern in grant.publish)


@pytest.mark.parametrize(
    "grant",
    [
        watching(spaces=("a", "b", "c", "d")),
        watching("a", "b", "c", "d", "e"),
        watching(stops=("a", "b", "c", "d", "e", "f", "g")),
        person(("ts/v1/a/b/c/ctl/1", "ts/v1/a/b/c/ctl/2")),
        person(("ts/v1/+/+/+/stop/account",)),
        person(("ts/v1/space/+/+/stop/+",)),
        person(subscribe=("#",)),
        person(subscribe=("ts/v1/space/+/+/state",)),
        person(("ts/v1/space/agent/arm/cmd",)),
        person(("ts/v1/space/${client.attributes.kind}/arm/stop/account",)),
        msgspec.structs.replace(AGENT, principal="account:x:y"),
        msgspec.structs.replace(AGENT, publish=AGENT.publish[1:]),
        grants.gateway_grant(client_id="s", token_id="t", lifetime_s=1),
        grants.service_grant(client_id="s", token_id="t", lifetime_s=1),
    ],
)
def test_a_grant_that_cannot_be_expressed_exactly_is_refused(grant: Grant) -> None:
    with pytest.raises(BrokerAccessError, match="Event Grid"):
        topic_spaces.attributes(grant)


def test_the_topic_space_of_the_functions_has_no_clients() -> None:
    space = topic_spaces.spaces()[topic_spaces.FUNCTIONS_SPACE]
    assert {f"ts/v1/+/+/+/{kind}" for kind in ("cmd", "stop/+", "state", "ack")} <= set(space)
    assert not any(
        covers(template, "ts/v1/s/a/arm/ctl/1") or covers(template, "ts/v1/s/a/arm/cam/x") for template in space
    )
    assert topic_spaces.FUNCTIONS_SPACE not in {bound.space for bound in topic_spaces.bindings()}


def test_microsofts_limits_are_respected() -> None:
    assert len(NAMESPACE.spaces) <= 10
    assert len(NAMESPACE.groups) <= 10
    assert len(NAMESPACE.bindings) <= 100
    for binding in NAMESPACE.bindings:
        assert binding["clientGroupName"] in NAMESPACE.groups
        assert binding["topicSpaceName"] in NAMESPACE.spaces
        assert binding["permission"] in {"Publisher", "Subscriber"}
    for name, templates in NAMESPACE.spaces.items():
        assert re.fullmatch(r"[A-Za-z0-9-]{3,50}", name)
        assert 1 <= len(templates) <= 10
        assert all(len(template) <= 256 and template.count("/") < 8 for template in templates)
    longest = "x" * 60
    many = watching(*(f"{longest}{each}" for each in "abcd"), spaces=tuple(f"{longest}{each}" for each in "abc"))
    assert len(json.dumps(topic_spaces.attributes(many))) < 4096


def test_the_command_writes_the_template(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert infra_azure.main([str(tmp_path / "grid.json")]) == 0
    assert infra_azure.main([]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((tmp_path / "grid.json").read_text())
    assert infra_azure.main([str(tmp_path)]) == 1
    assert "cannot write" in capsys.readouterr().err
