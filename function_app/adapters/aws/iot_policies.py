"""A grant as AWS IoT Core reads it: policy documents, with which its custom authoriser answers.

A ``*`` of a policy also matches slashes, which a ``+`` of MQTT does not. So each pattern with a ``+`` brings a denial
of the same with one level more: what the star matches in excess is denied.
Limits (AWS IoT Core, custom authentication): 10 documents of 2,048 characters, a principal of 128 letters and digits.
"""

import hashlib
import json
from collections.abc import Iterable
from typing import Any

from device_agent.protocol.security.grants import Grant, agent_grant
from function_app.ports.broker_access import BrokerAccessError

MAX_DOCUMENTS = 10
MAX_CHARACTERS = 2048
MIN_REFRESH_S, MAX_DISCONNECT_S = 300, 86_400
_VERSION = "2012-10-17"
_LONGEST = "arn:aws:iot:ap-southeast-1:123456789012"


def answer(grant: Grant, *, place: str, now_s: float) -> dict[str, Any]:
    """The authoriser's response that admits a connection at ``place``, ``arn:aws:iot:<region>:<account>``.

    Raises:
        BrokerAccessError: The grant names more topics than a response may contain.
    """
    duration_s = max(MIN_REFRESH_S, min(int(grant.expires_at - now_s), MAX_DISCONNECT_S))
    principal = hashlib.sha256(grant.principal.encode()).hexdigest()
    return _response(principal, duration_s, documents(grant, place=place))


def refusal() -> dict[str, Any]:
    """The authoriser's response that rejects a connection, without a reason."""
    return _response("denied", MIN_REFRESH_S, [])


def _response(principal: str, duration_s: int, policies: list[str]) -> dict[str, Any]:
    return {
        "isAuthenticated": bool(policies),
        "principalId": principal,
        "disconnectAfterInSeconds": duration_s,
        "refreshAfterInSeconds": duration_s,
        "policyDocuments": policies,
    }


def agents(*, place: str) -> list[str]:
    """What agents may do that show certificates: what their grant would say, of the thing that they are."""
    thing = "${iot:Connection.Thing.ThingName}"
    grant = agent_grant("${iot:Connection.Thing.Attributes[space]}", thing, token_id="", lifetime_s=0)
    # Parted as for the longest place, so that there are as many everywhere.
    return [document.replace(_LONGEST, place) for document in documents(grant, place=_LONGEST)]


def documents(grant: Grant, *, place: str) -> list[str]:
    """Exactly what a grant allows.

    Raises:
        BrokerAccessError: It names more topics than there is room for.
    """
    statements = [_statement("Allow", "iot:Connect", [f"{place}:client/{grant.client_id}"])]
    for action, kind, patterns in (
        ("iot:Publish", "topic", grant.publish),
        ("iot:RetainPublish", "topic", grant.publish),
        ("iot:Subscribe", "topicfilter", grant.subscribe),
        ("iot:Receive", "topic", grant.subscribe),
    ):
        for pattern in patterns:
            statements.append(_statement("Allow", action, [f"{place}:{kind}/{_stars(pattern)}"]))
            denied = [f"{place}:{kind}/{each}" for each in _deeper(pattern)]
            if denied:
                statements.append(_statement("Deny", action, denied))
    return _packed(statements)


def _stars(pattern: str) -> str:
    return "/".join("*" if level in {"+", "#"} else level for level in pattern.split("/"))


def _deeper(pattern: str) -> list[str]:
    """The pattern with one level more at each ``+``."""
    levels = pattern.split("/")
    if levels[-1] == "#":
        return []
    deeper = ([*levels[:place], "+", *levels[place:]] for place, level in enumerate(levels) if level == "+")
    return list(dict.fromkeys(_stars("/".join(each)) for each in deeper))


def _statement(effect: str, action: str, resources: list[str]) -> dict[str, Any]:
    return {"Effect": effect, "Action": action, "Resource": resources}


def _packed(statements: Iterable[dict[str, Any]]) -> list[str]:
    """As few documents as hold them all."""
    found: list[list[dict[str, Any]]] = [[]]
    for statement in statements:
        if len(_text([*found[-1], statement])) > MAX_CHARACTERS:
            found.append([])
        found[-1].append(statement)
    texts = [_text(each) for each in found]
    if len(texts) > MAX_DOCUMENTS or any(len(text) > MAX_CHARACTERS for text in texts):
        raise BrokerAccessError("AWS IoT Core takes no policy for so many topics; watch fewer spaces at once")
    return texts


def _text(statements: list[dict[str, Any]]) -> str:
    return json.dumps({"Version": _VERSION, "Statement": statements}, separators=(",", ":"))
