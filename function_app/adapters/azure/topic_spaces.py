"""Grants as an Event Grid namespace reads them: topic spaces, the same for all clients, and attributes of a client.

A topic space holds templates of topics, with variables that stand for a client's attributes; a permission binding lets
a client group say or hear one; a client is in a group by its attributes. So what one client may comes from its
attributes alone, which our webhook gives with each connection (``broker_access``). A variable covers one level at most
and a client without the attribute has no right by that template, so several devices are several numbered sets of
attributes: there are as many as there is room for templates.

Sources: Microsoft, "Topic spaces", "Client groups", "Access control for MQTT clients", "MQTT clients" (attributes: text
below 4 KB in all, names of letters, digits and underscores), "Quotas and limits" (10 topic spaces of 10 templates, 10
client groups, 100 bindings). What those pages leave open is not relied upon: lists as attributes, wildcards in them,
whole numbers in templates.
"""

import functools
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

import msgspec

from device_agent.protocol import topics
from device_agent.protocol.security import grants, revocation
from device_agent.protocol.security.grants import Grant
from function_app.ports.broker_access import BrokerAccessError

KIND = "kind"
"""The attribute by which a client is in its group."""
FUNCTIONS_SAY = "functions-say"
"""The topic space of what the functions publish, over HTTPS and by a role of Azure's: no client has part in it."""
MAX_SPACES, MAX_TEMPLATES, MAX_GROUPS, MAX_BINDINGS = 10, 10, 10, 100
MAX_ATTRIBUTES_BYTES = 4096 - 1
SPACES, DEVICES, STOPS = 3, 4, 6
"""Most whole spaces, and devices besides, that one connection watches; and devices besides that it may stop."""

Permission = Literal["Publisher", "Subscriber"]
_Said = tuple[Sequence[str], Sequence[str]]
"""What is published, what is subscribed to."""
_VARIABLE = re.compile(r"\$\{client\.attributes\.([A-Za-z0-9_]+)\}")


class Binding(NamedTuple):
    """A group's right to a topic space."""

    group: str
    space: str
    permission: Permission


class _Family(NamedTuple):
    """Topics that are given together, so many times over, each time with other attributes."""

    name: str
    copies: int
    variables: tuple[str, ...]
    topics: Callable[[Mapping[str, str]], _Said]

    def attributes(self, copy: int, values: Mapping[str, str]) -> dict[str, str]:
        return {f"{self.name}_{copy}_{variable}": values[variable] for variable in self.variables}

    def templates(self, copy: int) -> _Said:
        names = self.attributes(copy, {variable: variable for variable in self.variables})
        return self.topics({variable: f"${{client.attributes.{name}}}" for name, variable in names.items()})


def _of_agent(at: Mapping[str, str]) -> _Said:
    grant = grants.agent_grant(at["space"], at["agent"], token_id="", lifetime_s=0)
    return grant.publish, grant.subscribe


def _of_holder(at: Mapping[str, str]) -> _Said:
    return [topics.device(at["space"], at["agent"], at["device"], topics.CTL, at["epoch"])], ()


def _space_stop(at: Mapping[str, str]) -> _Said:
    return [topics.device(at["space"], topics.ANY, topics.ANY, topics.STOP)], ()


def _device_stop(at: Mapping[str, str]) -> _Said:
    return [topics.device(at["space"], at["agent"], at["device"], topics.STOP)], ()


def _space_heard(at: Mapping[str, str]) -> _Said:
    return (), grants.device_subscriptions(at["space"], topics.ANY, topics.ANY)


def _device_heard(at: Mapping[str, str]) -> _Said:
    return (), grants.device_subscriptions(at["space"], at["agent"], at["device"])


_DEVICE = ("space", "agent", "device")
_GROUPS: Mapping[str, tuple[str, tuple[_Family, ...]]] = {
    "agents": ("agent", (_Family("own", 1, ("space", "agent"), _of_agent),)),
    "people": (
        "account",
        (
            _Family("steers", 1, (*_DEVICE, "epoch"), _of_holder),
            _Family("stops_all", SPACES, ("space",), _space_stop),
            _Family("stops", STOPS, _DEVICE, _device_stop),
            _Family("hears_all", SPACES, ("space",), _space_heard),
            _Family("hears", DEVICES, _DEVICE, _device_heard),
        ),
    ),
}
"""Group → the kind of its clients, which is how their principals begin; and what they may."""


def groups() -> dict[str, str]:
    """Client group → the query that says who is in it."""
    return {group: f'attributes.{KIND} = "{kind}"' for group, (kind, _) in _GROUPS.items()}


@functools.cache
def spaces() -> dict[str, tuple[str, ...]]:
    """Topic space → its templates."""
    found: dict[str, tuple[str, ...]] = {}
    for group, (_, families) in _GROUPS.items():
        said, heard = _templates(families)
        found |= _parted(f"{group}-say", said) | _parted(f"{group}-hear", heard)
    # Revocations need no topic here: they are rows, which the webhook looks at.
    ours = tuple(topic for topic in grants.SERVICE_PUBLISH if topic != revocation.TOPIC)
    return found | _parted(FUNCTIONS_SAY, ours)


def bindings() -> tuple[Binding, ...]:
    """Who may say and hear which topic space."""
    found: list[Binding] = []
    permissions: tuple[tuple[str, Permission], ...] = (("say", "Publisher"), ("hear", "Subscriber"))
    for group, (verb, permission) in itertools.product(_GROUPS, permissions):
        found += [
            Binding(group, space, permission) for space in spaces() if re.fullmatch(f"{group}-{verb}(-[0-9]+)?", space)
        ]
    return tuple(found)


def attributes(grant: Grant) -> dict[str, str]:
    """What a client is to have so that it may exactly what its grant says.

    Raises:
        BrokerAccessError: The grant names too many topics, or topics that are never granted.
    """
    kind = grant.principal.partition(":")[0]
    families = next((families for known, families in _GROUPS.values() if known == kind), ())
    found = {KIND: kind}
    for family in families:
        fitting = list(_fitting(family, grant))
        if len(fitting) > family.copies:
            raise BrokerAccessError(
                "Event Grid takes no rights to so many topics; watch fewer spaces and devices at once"
            )
        for copy, values in enumerate(fitting, 1):
            found |= family.attributes(copy, values)
    if _granted(families, found) != (frozenset(grant.publish), frozenset(grant.subscribe)):
        raise BrokerAccessError(
            f"the topic spaces in Event Grid have no room for what '{grant.principal}' is to be given"
        )
    if len(msgspec.json.encode(found)) > MAX_ATTRIBUTES_BYTES:
        raise BrokerAccessError("Event Grid takes no rights to topics of such long names")
    return found


def _granted(families: Iterable[_Family], given: Mapping[str, str]) -> tuple[frozenset[str], frozenset[str]]:
    """What attributes come to: publish, subscribe."""
    said, heard = (
        frozenset(
            _VARIABLE.sub(lambda found: given[found[1]], template)
            for template in templates
            if all(name in given for name in _VARIABLE.findall(template))
        )
        for templates in _templates(families)
    )
    return said, heard


def _templates(families: Iterable[_Family]) -> _Said:
    said: list[str] = []
    heard: list[str] = []
    for family in families:
        for copy in range(1, family.copies + 1):
            publish, subscribe = family.templates(copy)
            said += publish
            heard += subscribe
    return said, heard


def _parted(name: str, templates: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """As few topic spaces as hold them all."""
    parts = [tuple(templates[start : start + MAX_TEMPLATES]) for start in range(0, len(templates), MAX_TEMPLATES)]
    return {f"{name}-{number}" if len(parts) > 1 else name: part for number, part in enumerate(parts, 1)}


def _fitting(family: _Family, grant: Grant) -> Iterator[dict[str, str]]:
    """The values with which all topics of a family are in a grant."""
    shape = family.topics({variable: f"{{{variable}}}" for variable in family.variables})
    patterns = (grant.publish, grant.subscribe)
    side = 0 if shape[0] else 1
    anchor = next(each for each in shape[side] if all(f"{{{variable}}}" in each for variable in family.variables))
    for pattern in patterns[side]:
        values = _values(anchor, pattern)
        if values is None:
            continue
        wanted = family.topics(values)
        if all(set(one) <= set(other) for one, other in zip(wanted, patterns, strict=True)):
            yield values


def _values(shape: str, pattern: str) -> dict[str, str] | None:
    """What stands in a pattern where a shape has ``{names}``. Only ids do: no wildcard, no slash, no variable."""
    wanted, given = shape.split("/"), pattern.split("/")
    if len(wanted) != len(given):
        return None
    values: dict[str, str] = {}
    for level, text in zip(wanted, given, strict=True):
        if level.startswith("{") and topics.is_id(text):
            values[level[1:-1]] = text
        elif level != text:
            return None
    return values
