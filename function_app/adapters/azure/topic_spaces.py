"""Converts grants to client attributes of an Event Grid namespace, and defines its topic spaces.

A topic space is a set of topic templates with variables for client attributes. A permission binding allows a client
group to publish or subscribe to a topic space. Attributes also select the client group. Therefore the attributes, which
the webhook returns for each connection (``broker_access``), determine all permissions of a client. A variable covers at
most one topic level, and a template does not apply to a client without the attribute. Several devices therefore need
several numbered sets of attributes, as many as the limits on templates allow.

Sources: Microsoft, "Topic spaces", "Client groups", "Access control for MQTT clients", "MQTT clients" (attributes: text
below 4 KB in total, names of letters, digits and underscores), "Quotas and limits" (10 topic spaces of 10 templates, 10
client groups, 100 bindings). The code does not use features that these pages do not define: lists as attributes,
wildcards in attributes, integers in templates.
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
"""The attribute that selects the client group."""
FUNCTIONS_SPACE = "functions-publish"
"""The topic space to which the functions publish over HTTPS with an Azure role. No client group has access."""
MAX_SPACES, MAX_TEMPLATES, MAX_GROUPS, MAX_BINDINGS = 10, 10, 10, 100
MAX_ATTRIBUTES_BYTES = 4096 - 1
SPACES, DEVICES, STOPS = 3, 4, 6
"""Limits of one connection: spaces to watch, single devices to watch, and single devices to stop."""

BindingKind = Literal["Publisher", "Subscriber"]
_Topics = tuple[Sequence[str], Sequence[str]]
"""Topics to publish, topic filters to subscribe."""
_VARIABLE = re.compile(r"\$\{client\.attributes\.([A-Za-z0-9_]+)\}")


class Binding(NamedTuple):
    """The permission of a client group on a topic space."""

    group: str
    space: str
    permission: BindingKind


class _Permission(NamedTuple):
    """Topics that are granted together, up to ``copies`` times with different attributes."""

    name: str
    copies: int
    variables: tuple[str, ...]
    topics: Callable[[Mapping[str, str]], _Topics]

    def attributes(self, copy: int, values: Mapping[str, str]) -> dict[str, str]:
        return {f"{self.name}_{copy}_{variable}": values[variable] for variable in self.variables}

    def templates(self, copy: int) -> _Topics:
        names = self.attributes(copy, {variable: variable for variable in self.variables})
        return self.topics({variable: f"${{client.attributes.{name}}}" for name, variable in names.items()})


def _agent_topics(values: Mapping[str, str]) -> _Topics:
    grant = grants.agent_grant(values["space"], values["agent"], token_id="", lifetime_s=0)
    return grant.publish, grant.subscribe


def _setpoint_topics(values: Mapping[str, str]) -> _Topics:
    return [topics.device(values["space"], values["agent"], values["device"], topics.CTL, values["epoch"])], ()


def _space_stop_topics(values: Mapping[str, str]) -> _Topics:
    return [topics.device(values["space"], topics.ANY, topics.ANY, topics.STOP, values["author"])], ()


def _device_stop_topics(values: Mapping[str, str]) -> _Topics:
    return [topics.device(values["space"], values["agent"], values["device"], topics.STOP, values["author"])], ()


def _space_filters(values: Mapping[str, str]) -> _Topics:
    return (), grants.device_subscriptions(values["space"], topics.ANY, topics.ANY)


def _device_filters(values: Mapping[str, str]) -> _Topics:
    return (), grants.device_subscriptions(values["space"], values["agent"], values["device"])


_DEVICE = ("space", "agent", "device")
_GROUPS: Mapping[str, tuple[str, tuple[_Permission, ...]]] = {
    "agents": ("agent", (_Permission("agent", 1, ("space", "agent"), _agent_topics),)),
    "accounts": (
        "account",
        (
            _Permission("control", 1, (*_DEVICE, "epoch"), _setpoint_topics),
            _Permission("stop_all", SPACES, ("space", "author"), _space_stop_topics),
            _Permission("stop", STOPS, (*_DEVICE, "author"), _device_stop_topics),
            _Permission("watch_all", SPACES, ("space",), _space_filters),
            _Permission("watch", DEVICES, _DEVICE, _device_filters),
        ),
    ),
}
"""Client group → kind of its clients (the first part of their principals), and their permissions."""


def groups() -> dict[str, str]:
    """Client group → membership query."""
    return {group: f'attributes.{KIND} = "{kind}"' for group, (kind, _) in _GROUPS.items()}


@functools.cache
def spaces() -> dict[str, tuple[str, ...]]:
    """Topic space → its templates."""
    result: dict[str, tuple[str, ...]] = {}
    for group, (_, permissions) in _GROUPS.items():
        publish, subscribe = _templates(permissions)
        result |= _split(f"{group}-publish", publish) | _split(f"{group}-subscribe", subscribe)
    # Revocations are rows that the webhook checks, not messages.
    functions = tuple(topic for topic in grants.SERVICE_PUBLISH if topic != revocation.TOPIC)
    return result | _split(FUNCTIONS_SPACE, functions)


def bindings() -> tuple[Binding, ...]:
    """The permissions of all client groups."""
    kinds: tuple[tuple[str, BindingKind], ...] = (("publish", "Publisher"), ("subscribe", "Subscriber"))
    return tuple(
        Binding(group, space, kind)
        for group, (operation, kind) in itertools.product(_GROUPS, kinds)
        for space in spaces()
        if re.fullmatch(f"{group}-{operation}(-[0-9]+)?", space)
    )


def attributes(grant: Grant) -> dict[str, str]:
    """Client attributes that permit exactly what the grant allows.

    Raises:
        BrokerAccessError: The grant names too many topics, or topics without a template.
    """
    kind = grant.principal.partition(":")[0]
    permissions = next((permissions for each, permissions in _GROUPS.values() if each == kind), ())
    result = {KIND: kind}
    for permission in permissions:
        matches = list(_matches(permission, grant))
        if len(matches) > permission.copies:
            raise BrokerAccessError("too many topics for Event Grid; watch fewer spaces and devices at the same time")
        for copy, values in enumerate(matches, 1):
            result |= permission.attributes(copy, values)
    if _granted(permissions, result) != (frozenset(grant.publish), frozenset(grant.subscribe)):
        raise BrokerAccessError(f"the topic spaces in Event Grid cannot express the grant of '{grant.principal}'")
    if len(msgspec.json.encode(result)) > MAX_ATTRIBUTES_BYTES:
        raise BrokerAccessError("the topic names are too long for the client attributes of Event Grid")
    return result


def _granted(permissions: Iterable[_Permission], values: Mapping[str, str]) -> tuple[frozenset[str], frozenset[str]]:
    """The topics and topic filters that a client with these attributes may use."""
    publish, subscribe = (
        frozenset(
            _VARIABLE.sub(lambda match: values[match[1]], template)
            for template in templates
            if all(name in values for name in _VARIABLE.findall(template))
        )
        for templates in _templates(permissions)
    )
    return publish, subscribe


def _templates(permissions: Iterable[_Permission]) -> _Topics:
    publish: list[str] = []
    subscribe: list[str] = []
    for permission in permissions:
        for copy in range(1, permission.copies + 1):
            topics_, filters = permission.templates(copy)
            publish += topics_
            subscribe += filters
    return publish, subscribe


def _split(name: str, templates: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The templates in as few topic spaces as possible."""
    parts = [tuple(templates[start : start + MAX_TEMPLATES]) for start in range(0, len(templates), MAX_TEMPLATES)]
    return {f"{name}-{number}" if len(parts) > 1 else name: part for number, part in enumerate(parts, 1)}


def _matches(permission: _Permission, grant: Grant) -> Iterator[dict[str, str]]:
    """Variable values for which the grant contains all topics of a permission."""
    templates = permission.topics({variable: f"{{{variable}}}" for variable in permission.variables})
    granted = (grant.publish, grant.subscribe)
    index = 0 if templates[0] else 1
    variables = [f"{{{variable}}}" for variable in permission.variables]
    anchor = next(each for each in templates[index] if all(variable in each for variable in variables))
    for pattern in granted[index]:
        values = _values(anchor, pattern)
        if values is None:
            continue
        if all(set(one) <= set(other) for one, other in zip(permission.topics(values), granted, strict=True)):
            yield values


def _values(template: str, pattern: str) -> dict[str, str] | None:
    """The levels of a pattern at the ``{names}`` of a template. Only ids match: no wildcard, slash or variable."""
    expected, actual = template.split("/"), pattern.split("/")
    if len(expected) != len(actual):
        return None
    values: dict[str, str] = {}
    for level, text in zip(expected, actual, strict=True):
        if level.startswith("{") and topics.is_id(text):
            values[level[1:-1]] = text
        elif level != text:
            return None
    return values
