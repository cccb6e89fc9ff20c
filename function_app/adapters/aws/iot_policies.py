"""Converts grants to policy documents of AWS IoT Core, for the responses of its custom authorizer.

In a policy, ``*`` also matches slashes; in MQTT, ``+`` does not. Therefore each topic filter with a ``+`` also yields a
Deny statement for the same filter with one more level.
Limits (AWS IoT Core, custom authentication): 10 documents of 2,048 characters, a principal of 128 letters and digits.
"""

import hashlib
import json
from collections.abc import Iterable
from typing import Any

from device_agent.protocol import topics
from device_agent.protocol.security.grants import Grant, agent_grant
from function_app.ports.broker_access import BrokerAccessError

MAX_DOCUMENTS = 10
MAX_CHARACTERS = 2048
MIN_REFRESH_S, MAX_DISCONNECT_S = 300, 86_400
_VERSION = "2012-10-17"
LONGEST_ARN_PREFIX = "arn:aws:iot:ap-southeast-1:123456789012"
"""Has the maximum length of a prefix."""


def admission(grant: Grant, *, arn_prefix: str, now_s: float) -> dict[str, Any]:
    """The authorizer's response that admits a connection; ``arn_prefix`` is ``arn:aws:iot:<region>:<account>``.

    Raises:
        BrokerAccessError: The grant names more topics than a response may contain.
    """
    duration_s = max(MIN_REFRESH_S, min(int(grant.expires_at - now_s), MAX_DISCONNECT_S))
    principal = hashlib.sha256(grant.principal.encode()).hexdigest()
    return _response(principal, duration_s, documents(grant, arn_prefix=arn_prefix))


def rejection() -> dict[str, Any]:
    """The authorizer's response that rejects a connection, without a reason."""
    return _response("denied", MIN_REFRESH_S, [])


def _response(principal: str, duration_s: int, policies: list[str]) -> dict[str, Any]:
    return {
        "isAuthenticated": bool(policies),
        "principalId": principal,
        "disconnectAfterInSeconds": duration_s,
        "refreshAfterInSeconds": duration_s,
        "policyDocuments": policies,
    }


def agents(*, arn_prefix: str) -> list[str]:
    """Policy documents of agents with certificates: the agent's grant, with variables of its thing."""
    thing = "${iot:Connection.Thing.ThingName}"
    grant = agent_grant("${iot:Connection.Thing.Attributes[space]}", thing, token_id="", lifetime_s=0)
    # Split for the longest prefix, so that the number of documents is the same in every region.
    texts = documents(grant, arn_prefix=LONGEST_ARN_PREFIX)
    return [text.replace(LONGEST_ARN_PREFIX, arn_prefix) for text in texts]


def documents(grant: Grant, *, arn_prefix: str) -> list[str]:
    """Policy documents that allow exactly what a grant allows.

    Raises:
        BrokerAccessError: The grant names more topics than the documents may contain.
    """
    statements = [_statement("Allow", "iot:Connect", [f"{arn_prefix}:client/{grant.client_id}"])]
    for action, kind, patterns in (
        ("iot:Publish", "topic", grant.publish),
        ("iot:RetainPublish", "topic", tuple(filter(topics.may_retain, grant.publish))),
        ("iot:Subscribe", "topicfilter", grant.subscribe),
        ("iot:Receive", "topic", grant.subscribe),
    ):
        for pattern in patterns:
            statements.append(_statement("Allow", action, [f"{arn_prefix}:{kind}/{_resource(pattern)}"]))
            denied = [f"{arn_prefix}:{kind}/{each}" for each in _with_extra_level(pattern)]
            if denied:
                statements.append(_statement("Deny", action, denied))
    return _pack(statements)


def _resource(pattern: str) -> str:
    return "/".join("*" if level in {"+", "#"} else level for level in pattern.split("/"))


def _with_extra_level(pattern: str) -> list[str]:
    """The pattern with an additional level at each ``+`` in turn."""
    levels = pattern.split("/")
    if levels[-1] == "#":
        return []
    deeper = ([*levels[:index], "+", *levels[index:]] for index, level in enumerate(levels) if level == "+")
    return list(dict.fromkeys(_resource("/".join(each)) for each in deeper))


def _statement(effect: str, action: str, resources: list[str]) -> dict[str, Any]:
    return {"Effect": effect, "Action": action, "Resource": resources}


def _pack(statements: Iterable[dict[str, Any]]) -> list[str]:
    """The statements in as few documents as possible."""
    groups: list[list[dict[str, Any]]] = [[]]
    for statement in statements:
        if len(_text([*groups[-1], statement])) > MAX_CHARACTERS:
            groups.append([])
        groups[-1].append(statement)
    texts = [_text(group) for group in groups]
    if len(texts) > MAX_DOCUMENTS or any(len(text) > MAX_CHARACTERS for text in texts):
        raise BrokerAccessError("too many topics for the policies of AWS IoT Core; watch fewer spaces at the same time")
    return texts


def _text(statements: list[dict[str, Any]]) -> str:
    return json.dumps({"Version": _VERSION, "Statement": statements}, separators=(",", ":"))
