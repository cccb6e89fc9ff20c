"""Policies of AWS IoT Core for grants, evaluated by the documented rules of AWS."""

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

ARN_PREFIX = "arn:aws:iot:eu-west-1:123456789012"
AGENT = agent_grant("space", "agentaaaaa", token_id="t", lifetime_s=3600)


def is_allowed(documents: list[str], action: str, resource: str) -> bool:
    """Deny overrides Allow; ``*`` matches any text."""
    effects = {"Allow": False, "Deny": False}
    for document in documents:
        for statement in json.loads(document)["Statement"]:
            if statement["Action"] == action and any(_matches(each, resource) for each in statement["Resource"]):
                effects[statement["Effect"]] = True
    return effects["Allow"] and not effects["Deny"]


def _matches(pattern: str, resource: str) -> bool:
    return re.fullmatch(".*".join(map(re.escape, pattern.split("*"))), f"{resource}", re.DOTALL) is not None


def may(grant: Grant, action: str, kind: str, name: str) -> bool:
    return is_allowed(
        iot_policies.documents(grant, arn_prefix=ARN_PREFIX), f"iot:{action}", f"{ARN_PREFIX}:{kind}/{name}"
    )


OWN = "ts/v1/space/agentaaaaa"
OTHER = "ts/v1/space/agentbbbbb"
ELSEWHERE = "ts/v1/other/agentaaaaa"


@pytest.mark.parametrize(
    ("action", "kind", "allowed", "denied"),
    [
        ("Connect", "client", ["agentaaaaa"], ["agentbbbbb"]),
        (
            "Publish",
            "topic",
            [f"{OWN}/conn", f"{OWN}/arm/tele/joints"],
            [
                f"{OWN}/arm/cmd",
                f"{OTHER}/arm/state",
                f"{ELSEWHERE}/arm/state",
                f"{OWN}/arm/cmd/state",
                f"{OWN}/a/b/c/state",
            ],
        ),
        ("RetainPublish", "topic", [f"{OWN}/arm/state"], [f"{OTHER}/arm/state", f"{OWN}/arm/tele/joints"]),
        (
            "Subscribe",
            "topicfilter",
            [f"{OWN}/+/cmd", f"{OWN}/arm/cmd"],
            ["#", f"{OWN}/#", "ts/v1/+/+/+/cmd", "ts/v1/space/+/+/state"],
        ),
        (
            "Receive",
            "topic",
            [f"{OWN}/arm/ctl/5", f"{OTHER}/zone/tele/presence"],
            [f"{OTHER}/arm/cmd", "ts/v1/other/agentbbbbb/zone/tele/presence"],
        ),
    ],
)
def test_an_agent_may_do_exactly_what_its_grant_allows(
    action: str, kind: str, allowed: list[str], denied: list[str]
) -> None:
    for topic in (*allowed, *denied):
        assert may(AGENT, action, kind, topic) == (topic in allowed), topic


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


def test_documents_respect_the_limits_of_aws() -> None:
    documents = iot_policies.documents(grant_of(4), arn_prefix=ARN_PREFIX)
    assert 1 < len(documents) <= iot_policies.MAX_DOCUMENTS
    assert all(len(document) <= iot_policies.MAX_CHARACTERS for document in documents)
    with pytest.raises(BrokerAccessError, match="too many topics"):
        iot_policies.documents(grant_of(100), arn_prefix=ARN_PREFIX)


def test_the_response_has_the_format_of_an_authorizer() -> None:
    response = iot_policies.admission(AGENT, arn_prefix=ARN_PREFIX, now_s=AGENT.expires_at - 1000)
    assert response["isAuthenticated"] is True
    assert re.fullmatch("[a-zA-Z0-9]{1,128}", response["principalId"])
    assert response["disconnectAfterInSeconds"] == 1000
    assert iot_policies.rejection()["isAuthenticated"] is False


def test_policies_of_agents_with_certificates_equal_their_grants() -> None:
    documents = [
        document.replace("${iot:Connection.Thing.Attributes[space]}", "space").replace(
            "${iot:Connection.Thing.ThingName}", "agentaaaaa"
        )
        for document in iot_policies.agents(arn_prefix=ARN_PREFIX)
    ]
    assert {*map(str, _statements(documents))} == {
        *map(str, _statements(iot_policies.documents(AGENT, arn_prefix=ARN_PREFIX)))
    }
    assert all(len(document) <= iot_policies.MAX_CHARACTERS for document in iot_policies.agents(arn_prefix=ARN_PREFIX))


def _statements(documents: list[str]) -> list[Any]:
    return [statement for document in documents for statement in json.loads(document)["Statement"]]
