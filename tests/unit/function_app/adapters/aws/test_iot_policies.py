"""A grant as AWS IoT Core reads it: judged here as its documents say that policies are."""

import json
import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.protocol import topics
from device_agent.protocol.security.grants import Grant, agent_grant
from function_app.adapters.aws import iot_policies
from function_app.ports.broker_access import BrokerAccessError

PLACE = "arn:aws:iot:eu-west-1:123456789012"
AGENT = agent_grant("space", "agentaaaaa", token_id="t", lifetime_s=3600)


def allowed(documents: list[str], action: str, resource: str) -> bool:
    """A denial wins, then any allowance; a star matches anything."""
    said = {"Allow": False, "Deny": False}
    for document in documents:
        for statement in json.loads(document)["Statement"]:
            if statement["Action"] == action and any(_matches(each, resource) for each in statement["Resource"]):
                said[statement["Effect"]] = True
    return said["Allow"] and not said["Deny"]


def _matches(pattern: str, resource: str) -> bool:
    return re.fullmatch(".*".join(map(re.escape, pattern.split("*"))), f"{resource}", re.DOTALL) is not None


def may(grant: Grant, action: str, kind: str, name: str) -> bool:
    return allowed(iot_policies.documents(grant, place=PLACE), f"iot:{action}", f"{PLACE}:{kind}/{name}")


def test_only_its_own_client_id_connects() -> None:
    assert may(AGENT, "Connect", "client", "agentaaaaa")
    assert not may(AGENT, "Connect", "client", "agentbbbbb")


OWN = "ts/v1/space/agentaaaaa"


@pytest.mark.parametrize(
    ("action", "kind", "topic"),
    [
        ("Publish", "topic", f"{OWN}/conn"),
        ("RetainPublish", "topic", f"{OWN}/arm/state"),
        ("Publish", "topic", f"{OWN}/arm/tele/joints"),
        ("Subscribe", "topicfilter", f"{OWN}/+/cmd"),
        ("Subscribe", "topicfilter", f"{OWN}/arm/cmd"),
        ("Receive", "topic", f"{OWN}/arm/ctl/5"),
        ("Receive", "topic", "ts/v1/space/agentbbbbb/zone/tele/presence"),
    ],
)
def test_an_agent_may_what_its_grant_says(action: str, kind: str, topic: str) -> None:
    assert may(AGENT, action, kind, topic)


@pytest.mark.parametrize(
    ("action", "kind", "topic"),
    [
        ("Publish", "topic", f"{OWN}/arm/cmd"),
        ("Publish", "topic", "ts/v1/space/agentbbbbb/arm/state"),
        ("Publish", "topic", "ts/v1/other/agentaaaaa/arm/state"),
        ("Publish", "topic", f"{OWN}/arm/cmd/state"),
        ("Publish", "topic", f"{OWN}/a/b/c/state"),
        ("Subscribe", "topicfilter", "#"),
        ("Subscribe", "topicfilter", f"{OWN}/#"),
        ("Subscribe", "topicfilter", "ts/v1/+/+/+/cmd"),
        ("Subscribe", "topicfilter", "ts/v1/space/+/+/state"),
        ("Receive", "topic", "ts/v1/space/agentbbbbb/arm/cmd"),
        ("Receive", "topic", "ts/v1/other/agentbbbbb/zone/tele/presence"),
    ],
)
def test_and_nothing_else(action: str, kind: str, topic: str) -> None:
    assert not may(AGENT, action, kind, topic)


LEVEL = st.sampled_from(["space", "other", "agentaaaaa", "arm", "state", "cmd", "tele", "x", "stop"])


@given(st.lists(LEVEL, min_size=1, max_size=6))
def test_the_policy_allows_no_topic_outside_the_grant(levels: list[str]) -> None:
    topic = "/".join(["ts", "v1", *levels])
    if may(AGENT, "Publish", "topic", topic):
        assert AGENT.may_publish(topic)
    if may(AGENT, "Receive", "topic", topic):
        assert any(topics.matches(pattern, topic) for pattern in AGENT.subscribe)


def grant_of(spaces: int) -> Grant:
    patterns = tuple(f"ts/v1/space{number:011d}/+/+/{kind}" for number in range(spaces) for kind in ("desc", "state"))
    return Grant(principal="account:a:s", client_id="w", publish=(), subscribe=patterns, token_id="t", expires_at=10**9)


def test_documents_keep_to_amazons_limits() -> None:
    found = iot_policies.documents(grant_of(4), place=PLACE)
    assert 1 < len(found) <= iot_policies.MAX_DOCUMENTS
    assert all(len(document) <= iot_policies.MAX_CHARACTERS for document in found)
    with pytest.raises(BrokerAccessError, match="so many topics"):
        iot_policies.documents(grant_of(100), place=PLACE)


def test_the_answer_is_as_the_authoriser_must_give_it() -> None:
    answer: dict[str, Any] = iot_policies.answer(AGENT, place=PLACE, now_s=AGENT.expires_at - 1000)
    assert answer["isAuthenticated"] is True
    assert re.fullmatch("[a-zA-Z0-9]{1,128}", answer["principalId"])
    assert answer["disconnectAfterInSeconds"] == 1000
    assert iot_policies.refusal()["isAuthenticated"] is False


def test_agents_with_certificates_may_what_their_grant_says_in_the_space_of_their_thing_alone() -> None:
    found = [
        document.replace("${iot:Connection.Thing.Attributes[space]}", "space").replace(
            "${iot:Connection.Thing.ThingName}", "agentaaaaa"
        )
        for document in iot_policies.agents(place=PLACE)
    ]
    assert {*map(str, _statements(found))} == {*map(str, _statements(iot_policies.documents(AGENT, place=PLACE)))}
    assert all(len(document) <= iot_policies.MAX_CHARACTERS for document in iot_policies.agents(place=PLACE))


def _statements(documents: list[str]) -> list[Any]:
    return [statement for document in documents for statement in json.loads(document)["Statement"]]
