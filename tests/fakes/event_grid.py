"""A fake Event Grid namespace that implements the documented authorization on the embedded MQTT broker.

It reads the ARM template of ``python -m infra.azure``. A group contains the clients whose attributes match its query. A
binding allows a group to publish or subscribe to a topic space. Variables of topic templates are replaced with client
attributes; a template with a missing attribute grants nothing. A template must match the whole topic, or cover the
whole filter. Only a client with the same authentication name can take over a session. Connections do not end at their
``expiration``, because the documentation does not specify this.
"""

import asyncio
import base64
import contextlib
import json
import math
import re
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from function_app.adapters.azure.broker_access import EventGridBrokerAccess
from function_app.adapters.azure.command_bus import EventGridCommandBus
from function_app.adapters.azure.session_takeover import SessionTakeover
from function_app.adapters.azure.topic_spaces import FUNCTIONS_SPACE
from function_app.entrypoints.broker_auth.event_grid import admit
from function_app.ports.command_bus import BusUnavailable
from function_app.settings import EventGridBus, EventGridWebhook
from infra.azure.__main__ import template
from infra.embedded_broker import packets
from infra.embedded_broker.broker import TCP, WEBSOCKET, TelescopeBroker
from infra.embedded_broker.connection import Admission, Refused
from infra.embedded_broker.packets import Connect
from tests.harness.cloud.cloud import Cloud, settings
from tests.harness.network.brokers import RunningBroker

HOST = "127.0.0.1"
Webhook = Callable[[dict[str, Any]], dict[str, Any]]
_QUERY = re.compile(r'attributes\.(\w+) = "([^"]*)"')
_VARIABLE = re.compile(r"\$\{client\.(authenticationName|attributes\.(\w+))\}")


def covers(template: str, pattern: str) -> bool:
    """Whether ``template`` matches every topic that ``pattern`` (a topic or a filter) matches."""
    allowed, requested = template.split("/"), pattern.split("/")
    while allowed and allowed[0] != "#":
        if not requested or requested[0] == "#" or (allowed[0] != "+" and allowed[0] != requested[0]):
            return False
        allowed, requested = allowed[1:], requested[1:]
    return bool(allowed) or not requested


@dataclass(frozen=True)
class Client:
    """A client that the webhook has accepted."""

    name: str
    attributes: Mapping[str, Any] = field(default_factory=dict)


class Namespace:
    """Client groups, topic spaces and permission bindings of a template."""

    def __init__(self, template: Mapping[str, Any]) -> None:
        self.groups: dict[str, str] = {}
        self.spaces: dict[str, list[str]] = {}
        self.bindings: list[dict[str, str]] = []
        for resource in template["resources"]:
            kind = resource["type"].rpartition("/")[2]
            name = re.search(r"\{0\}/([A-Za-z0-9-]{3,50})'", resource["name"])
            properties = resource["properties"]
            if kind == "clientGroups" and name:
                self.groups[name[1]] = properties["query"]
            elif kind == "topicSpaces" and name:
                self.spaces[name[1]] = properties["topicTemplates"]
            elif kind == "permissionBindings" and name:
                self.bindings.append(properties)

    def may(self, client: Client, permission: str, pattern: str) -> bool:
        """Whether a client has this permission for a topic, or for a whole filter."""
        if pattern.startswith("$"):
            return False
        return any(
            covers(allowed, pattern)
            for binding in self.bindings
            if binding["permission"] == permission and self._in_group(client, binding["clientGroupName"])
            for template in self.spaces[binding["topicSpaceName"]]
            if (allowed := self._substitute(template, client)) is not None
        )

    def _in_group(self, client: Client, group: str) -> bool:
        query = _QUERY.fullmatch(self.groups[group])
        assert query, f"unsupported query: {self.groups[group]}"
        return bool(client.attributes.get(query[1]) == query[2])

    @staticmethod
    def _substitute(template: str, client: Client) -> str | None:
        values = {"authenticationName": client.name} | {
            f"attributes.{name}": value for name, value in client.attributes.items()
        }
        if any(not isinstance(values.get(variable[1]), str) for variable in _VARIABLE.finditer(template)):
            return None
        return _VARIABLE.sub(lambda variable: str(values[variable[1]]), template)


@dataclass(frozen=True)
class Rights:
    """Permissions of one connection, instead of the grant of the embedded broker."""

    namespace: Namespace | None
    client: Client
    client_id: str
    principal: str = ""
    expires_at: float = math.inf

    def may_publish(self, topic: str) -> bool:
        return "+" not in topic and "#" not in topic and self._may("Publisher", topic)

    def may_subscribe(self, pattern: str) -> bool:
        return self._may("Subscriber", pattern)

    def _may(self, permission: str, pattern: str) -> bool:
        return self.namespace is None or self.namespace.may(self.client, permission, pattern)


class _NoKeys:
    def refresh(self) -> bool:
        return False

    def close(self) -> None:
        pass


class EventGrid(TelescopeBroker):
    """The namespace's MQTT broker. Set ``webhook`` before the first connection."""

    def __init__(self, namespace: Namespace, sockets: Mapping[str, socket.socket]) -> None:
        unused: Any = _NoKeys()
        super().__init__(sockets=sockets, keys=unused, revocations=unused)
        self.namespace = namespace
        self.webhook: Webhook | None = None
        self.http_topics: list[str] = []
        """Topics of messages that were published over HTTPS; these are not delivered."""
        self.unrestricted_client: str = ""
        """Id of a client with all permissions, for tests."""

    def authenticate(self, connect: Connect) -> Admission:
        rights: Any
        if self.unrestricted_client and connect.client_id == self.unrestricted_client:
            rights = Rights(None, Client(connect.client_id), connect.client_id)
            return Admission(rights, "", 0)
        assert self.webhook is not None
        response = self.webhook(
            {
                "clientId": connect.client_id,
                "userName": connect.username,
                "password": base64.b64encode(connect.password.encode()).decode(),
            }
        )
        if response.get("decision") != "allow":
            raise Refused(packets.NOT_AUTHORISED, str(response.get("errorReason")))
        client = Client(response["clientAuthenticationName"], response["attributes"])
        assert len(json.dumps(response["attributes"])) < 4096
        assert all(re.fullmatch(r"\w+", name) for name in client.attributes)
        existing = self._clients.get(connect.client_id)
        if existing is not None and existing.admission is not None:
            rights = existing.admission.grant
            if rights.client.name.lower() != client.name.lower():
                raise Refused(packets.NOT_AUTHORISED, "the session belongs to another authentication name")
        rights = Rights(self.namespace, client, connect.client_id)
        return Admission(rights, "", 0)


ENTRA_ID = "11059fcc-5514-4800-b5f8-49808b9cfab6"
CALLER = "of the namespace"
"""Represents the token of the namespace's identity."""


@contextlib.contextmanager
def start_event_grid(namespace: Namespace | None = None) -> Iterator[tuple[EventGrid, dict[str, int]]]:
    """The namespace's broker and its loopback ports, until the context ends."""
    sockets = {}
    for name in (TCP, WEBSOCKET):
        sockets[name] = socket.create_server((HOST, 0))
        sockets[name].setblocking(False)
    ports = {name: bound.getsockname()[1] for name, bound in sockets.items()}
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    async def start() -> EventGrid:
        grid = EventGrid(namespace or Namespace(template()), sockets)
        await grid.start()
        return grid

    try:
        grid = asyncio.run_coroutine_threadsafe(start(), loop).result(10)
        yield grid, ports
        asyncio.run_coroutine_threadsafe(grid.shutdown(), loop).result(10)
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        for bound in sockets.values():
            bound.close()
        loop.run_until_complete(loop.shutdown_default_executor())
        loop.close()


@contextlib.contextmanager
def event_grid_cloud(home: Path) -> Iterator[tuple[Cloud, RunningBroker, EventGrid]]:
    """The functions with a fake namespace as broker and command bus."""
    with start_event_grid() as (grid, ports), pytest.MonkeyPatch.context() as patch:
        patch.setattr(EventGridCommandBus, "publish", _publisher(grid))
        webhook = EventGridWebhook(tenant=ENTRA_ID, audience=f"api://{ENTRA_ID}", caller=ENTRA_ID)
        bus = EventGridBus(endpoint="https://lab.westeurope-1.ts.eventgrid.azure.net", webhook=webhook)
        chosen = replace(settings(home), broker="eventgrid", bus=bus, mqtt_host=HOST, mqtt_port=ports[TCP])
        with Cloud(chosen) as cloud:
            access = cloud.functions.access
            assert isinstance(access, EventGridBrokerAccess)
            access._take_over = SessionTakeover(host=HOST, port=ports[TCP], tls=None)
            access.verify_caller = _verify_caller
            grid.webhook = lambda request: _call_webhook(cloud, request)
            process: Any = None
            kind: Any = "eventgrid"
            broker = RunningBroker(kind, home, process, ports[TCP], ports[WEBSOCKET], cloud.loop, access=access)
            yield cloud, broker, grid


async def _verify_caller(token: str) -> bool:
    return token == CALLER


def _call_webhook(cloud: Cloud, request: dict[str, Any]) -> dict[str, Any]:
    try:
        status, response = cloud.run(admit(cloud.functions, f"Bearer {CALLER}", json.dumps(request).encode()))
    except Exception:  # noqa: BLE001 (like the namespace: every failure rejects the client)
        return {}
    return response if status == 200 else {}


def _publisher(grid: EventGrid) -> Callable[..., Any]:
    """A replacement for publishing over HTTPS, limited to the topic space of the functions."""

    async def publish(_: Any, topic: str, *__: Any, **___: Any) -> None:
        if not any(covers(each, topic) for each in grid.namespace.spaces[FUNCTIONS_SPACE]):
            raise BusUnavailable(f"the functions may not publish to {topic}")
        grid.http_topics.append(topic)

    return publish
