"""A fake of an Event Grid namespace: its authorisation, by the pages that Microsoft has written about it.

Read from the ARM template that ``python -m infra.azure`` prints, by rules of its own: a client is in a group by the
group's query over its attributes; a binding lets a group publish, or subscribe, to a topic space; the variables of a
template stand for the client's attributes, and a client without one has no right by it; a topic is allowed that one
template matches, a filter that one template covers whole. MQTT itself is the embedded broker's, so that real clients
connect, and a session is taken over by the same authentication name and by no other. Connections do not end at their
``expiration``: it is not written that they do.
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
"""What the namespace asks, and what it is answered."""
_QUERY = re.compile(r'attributes\.(\w+) = "([^"]*)"')
_VARIABLE = re.compile(r"\$\{client\.(authenticationName|attributes\.(\w+))\}")


def covers(template: str, wanted: str) -> bool:
    """Whether every topic that ``wanted`` (a topic or a filter) matches is matched by ``template``."""
    levels, asked = template.split("/"), wanted.split("/")
    while levels and levels[0] != "#":
        if not asked or asked[0] == "#" or (levels[0] != "+" and levels[0] != asked[0]):
            return False
        levels, asked = levels[1:], asked[1:]
    return bool(levels) or not asked


@dataclass(frozen=True)
class Client:
    """A client that the webhook has admitted."""

    name: str
    attributes: Mapping[str, Any] = field(default_factory=dict)


class Namespace:
    """Client groups, topic spaces and permission bindings, as the template says."""

    def __init__(self, template: Mapping[str, Any]) -> None:
        self.groups: dict[str, str] = {}
        self.spaces: dict[str, list[str]] = {}
        self.bindings: list[dict[str, str]] = []
        for resource in template["resources"]:
            kind = resource["type"].rpartition("/")[2]
            named = re.search(r"\{0\}/([A-Za-z0-9-]{3,50})'", resource["name"])
            said = resource["properties"]
            if kind == "clientGroups" and named:
                self.groups[named[1]] = said["query"]
            elif kind == "topicSpaces" and named:
                self.spaces[named[1]] = said["topicTemplates"]
            elif kind == "permissionBindings" and named:
                self.bindings.append(said)

    def may(self, client: Client, permission: str, wanted: str) -> bool:
        """Whether a client has this permission for a topic, or for all of a filter."""
        if wanted.startswith("$"):
            return False
        return any(
            covers(pattern, wanted)
            for bound in self.bindings
            if bound["permission"] == permission and self._in(client, bound["clientGroupName"])
            for template in self.spaces[bound["topicSpaceName"]]
            if (pattern := self._put_in(template, client)) is not None
        )

    def _in(self, client: Client, group: str) -> bool:
        found = _QUERY.fullmatch(self.groups[group])
        assert found, f"the fake cannot read the query {self.groups[group]}"
        return bool(client.attributes.get(found[1]) == found[2])

    @staticmethod
    def _put_in(template: str, client: Client) -> str | None:
        known = {"authenticationName": client.name} | {
            f"attributes.{name}": value for name, value in client.attributes.items()
        }
        if any(not isinstance(known.get(found[1]), str) for found in _VARIABLE.finditer(template)):
            return None
        return _VARIABLE.sub(lambda found: str(known[found[1]]), template)


@dataclass(frozen=True)
class Rights:
    """Of one connection; where the embedded broker has a grant."""

    namespace: Namespace | None
    client: Client
    client_id: str
    principal: str = ""
    expires_at: float = math.inf

    def may_publish(self, topic: str) -> bool:
        return "+" not in topic and "#" not in topic and self._may("Publisher", topic)

    def may_subscribe(self, pattern: str) -> bool:
        return self._may("Subscriber", pattern)

    def _may(self, permission: str, wanted: str) -> bool:
        return self.namespace is None or self.namespace.may(self.client, permission, wanted)


class _Nothing:
    def refresh(self) -> bool:
        return False

    def close(self) -> None:
        """Nothing."""


class EventGrid(TelescopeBroker):
    """The namespace's MQTT broker. Set ``webhook`` before the first connection."""

    def __init__(self, namespace: Namespace, sockets: Mapping[str, socket.socket]) -> None:
        nothing: Any = _Nothing()
        super().__init__(sockets=sockets, keys=nothing, revocations=nothing)
        self.namespace = namespace
        self.webhook: Webhook | None = None
        self.asked = 0
        self.said: list[str] = []
        """What was published over HTTPS; it goes no further."""
        self.everything: str = ""
        """Grant all rights to this client id, for tests."""

    def authenticate(self, connect: Connect) -> Admission:
        if self.everything and connect.client_id == self.everything:
            rights: Any = Rights(None, Client(connect.client_id), connect.client_id)
            return Admission(rights, "", 0)
        assert self.webhook is not None
        self.asked += 1
        answer = self.webhook(
            {
                "clientId": connect.client_id,
                "userName": connect.username,
                "password": base64.b64encode(connect.password.encode()).decode(),
            }
        )
        if answer.get("decision") != "allow":
            raise Refused(packets.NOT_AUTHORISED, str(answer.get("errorReason")))
        client = Client(answer["clientAuthenticationName"], answer["attributes"])
        assert len(json.dumps(answer["attributes"])) < 4096
        assert all(re.fullmatch(r"\w+", name) for name in client.attributes)
        before = self._clients.get(connect.client_id)
        if before is not None and before.admission is not None:
            held: Any = before.admission.grant
            if held.client.name.lower() != client.name.lower():
                raise Refused(packets.NOT_AUTHORISED, "the session is another's")
        rights = Rights(self.namespace, client, connect.client_id)
        return Admission(rights, "", 0)


ENTRA_ID = "11059fcc-5514-4800-b5f8-49808b9cfab6"
CALLER = "of the namespace"
"""Stands for its identity's token."""


@contextlib.contextmanager
def start_event_grid(namespace: Namespace | None = None) -> Iterator[tuple[EventGrid, dict[str, int]]]:
    """The namespace's broker on free loopback ports, for the time of a ``with``; and the ports."""
    sockets = {}
    for name in (TCP, WEBSOCKET):
        sockets[name] = socket.create_server((HOST, 0))
        sockets[name].setblocking(False)
    ports = {name: bound.getsockname()[1] for name, bound in sockets.items()}
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    async def start() -> EventGrid:
        made = EventGrid(namespace or Namespace(template()), sockets)
        await made.start()
        return made

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
    """The functions with a namespace as their broker and bus."""
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
            grid.webhook = lambda asked: _ask(cloud, asked)
            process: Any = None
            kind: Any = "eventgrid"
            broker = RunningBroker(kind, home, process, ports[TCP], ports[WEBSOCKET], cloud.loop, access=access)
            yield cloud, broker, grid


async def _verify_caller(token: str) -> bool:
    return token == CALLER


def _ask(cloud: Cloud, asked: dict[str, Any]) -> dict[str, Any]:
    try:
        status, answer = cloud.run(admit(cloud.functions, f"Bearer {CALLER}", json.dumps(asked).encode()))
    except Exception:  # noqa: BLE001 (like the namespace: every failure rejects the client)
        return {}
    return answer if status == 200 else {}


def _publisher(grid: EventGrid) -> Callable[..., Any]:
    """What publishing over HTTPS does, with the functions' role on their one topic space."""

    async def publish(_: Any, topic: str, *__: Any, **___: Any) -> None:
        if not any(covers(each, topic) for each in grid.namespace.spaces[FUNCTIONS_SPACE]):
            raise BusUnavailable(f"Event Grid does not let the functions publish to {topic}")
        grid.said.append(topic)

    return publish
