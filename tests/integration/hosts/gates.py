"""Brokers that authorize each connection by a webhook of the functions."""

import base64
import json
import time
from http.server import ThreadingHTTPServer
from typing import Any, Protocol
from urllib.parse import urlsplit

from device_agent.protocol.security import grants
from device_agent.protocol.security.grants import Grant
from function_app.domain.common.ids import new_id
from function_app.entrypoints.broker_auth.event_grid import admit
from function_app.entrypoints.broker_auth.iot_core import authorise
from function_app.ports.broker_access import BrokerAccess, Credentials
from tests.fakes.event_grid import CALLER, EventGrid
from tests.harness.cloud.cloud import Cloud
from tests.harness.network.brokers import HOST, Client, RunningBroker
from tests.harness.network.http_server import QuietHandler


def grant(account: str, name: str = "watch", *, lifetime_s: float = 900) -> Grant:
    return Grant(
        principal=f"account:{account}:s1:watch",
        client_id=f"{name}-{account}",
        publish=(f"ts/v1/{account}/+/+/stop/{account}",),
        subscribe=grants.device_subscriptions(account, "+", "+"),
        token_id=new_id(),
        expires_at=int(time.time() + lifetime_s),
    )


def encoded(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


class Gate(Protocol):
    """A broker and its webhook, with one interface for both kinds of broker."""

    cloud: Cloud

    def admits(self, credentials: Credentials, client_id: str) -> bool:
        """The webhook's response about a connection."""

    def connect(self, grant: Grant) -> Credentials:
        """Connect with new credentials."""

    def is_connected(self, grant: Grant) -> bool: ...

    def ended(self, grant: Grant) -> bool:
        """Whether the connection ends in time."""


def access(gate: Gate) -> BrokerAccess:
    return gate.cloud.functions.access


def issue(gate: Gate, grant: Grant) -> Credentials:
    return gate.cloud.run(access(gate).issue(grant))


ARN = "arn:aws:lambda:eu-west-1:123456789012:function:telescope"


class Connections(ThreadingHTTPServer):
    """The connected clients; a fake."""

    def __init__(self) -> None:
        super().__init__((HOST, 0), _Disconnect)
        self.connected: set[str] = set()


class _Disconnect(QuietHandler):
    server: Connections

    def handle_any(self) -> None:
        client_id = urlsplit(self.path).path.rpartition("/")[2]
        if client_id in self.server.connected:
            self.server.connected.discard(client_id)
            self.respond_json({})
        else:
            self.respond(404, [("x-amzn-ErrorType", "ResourceNotFoundException")], b'{"message": "not connected"}')


class IotGate:
    def __init__(self, cloud: Cloud, connections: Connections) -> None:
        self.cloud, self._connections = cloud, connections

    def call_webhook(self, username: str, password: str, client_id: str) -> dict[str, Any]:
        client = {"username": username, "password": encoded(password), "clientId": client_id}
        event = {"protocols": ["tls", "mqtt"], "protocolData": {"mqtt": client}}
        return self.cloud.run(authorise(self.cloud.functions, event, ARN))

    def admits(self, credentials: Credentials, client_id: str) -> bool:
        answer = self.call_webhook(*credentials, client_id)
        assert bool(answer["policyDocuments"]) == answer["isAuthenticated"]
        return bool(answer["isAuthenticated"])

    def connect(self, grant: Grant) -> Credentials:
        self._connections.connected.add(grant.client_id)
        return issue(self, grant)

    def is_connected(self, grant: Grant) -> bool:
        return grant.client_id in self._connections.connected

    def ended(self, grant: Grant) -> bool:
        return not self.is_connected(grant)


class GridGate:
    def __init__(self, cloud: Cloud, broker: RunningBroker, grid: EventGrid) -> None:
        self.cloud, self.broker, self.grid = cloud, broker, grid
        self.clients: dict[str, Client] = {}

    def call_webhook(self, request: Any, *, authorization: str = f"Bearer {CALLER}") -> tuple[int, dict[str, Any]]:
        body = request if isinstance(request, bytes) else json.dumps(request).encode()
        return self.cloud.run(admit(self.cloud.functions, authorization, body))

    def authorize(self, credentials: Credentials, client_id: str) -> dict[str, Any]:
        status, answer = self.call_webhook(request_of(credentials, client_id))
        assert status == 200
        return answer

    def admits(self, credentials: Credentials, client_id: str) -> bool:
        answer = self.authorize(credentials, client_id)
        allowed = bool(answer["decision"] == "allow")
        assert allowed or set(answer) == {"decision", "errorReason"}
        assert self.broker.accepts(client_id, credentials) == allowed
        return allowed

    def connect(self, grant: Grant) -> Credentials:
        credentials = self.broker.issue(grant)
        client = self.clients[grant.client_id] = self.broker.connect(grant.client_id, credentials)
        assert client.connected.is_set(), client.answer
        return credentials

    def is_connected(self, grant: Grant) -> bool:
        return not self.clients[grant.client_id].disconnected.is_set()

    def ended(self, grant: Grant) -> bool:
        return self.clients[grant.client_id].ended()


def request_of(credentials: Credentials, client_id: str) -> dict[str, Any]:
    return {"clientId": client_id, "userName": credentials.username, "password": encoded(credentials.password)}
