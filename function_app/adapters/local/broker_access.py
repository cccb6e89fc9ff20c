"""Broker permissions: signed tokens for the embedded broker, or clients and roles in mosquitto."""

import asyncio
import math
import secrets
import socket
import ssl
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import paho.mqtt.client as paho
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.reasoncodes import ReasonCode

from device_agent.protocol import codec
from device_agent.protocol.security import grants, revocation
from device_agent.protocol.security.grants import Grant
from device_agent.protocol.security.revocation import Control, Revoke
from function_app.adapters.local import mosquitto_clients
from function_app.adapters.local.mosquitto_clients import ClientQuota, IssuedClient
from function_app.adapters.shared.mqtt_client import close_client
from function_app.ports.broker_access import BrokerAccessError, Credentials, ServiceCredentials, check_revocation

Publish = Callable[[str, bytes], Awaitable[None]]
"""Publishes as a service at QoS 1; returns when the broker has acknowledged the message, otherwise raises."""

_SERVICE_TOKEN_S = 24 * 3_600.0
_SECURITY = "$CONTROL/dynamic-security/v1"
_RESPONSES = f"{_SECURITY}/response"
_TIMEOUT_S = 10.0
_MAX_COMMANDS = 100


def _service_client_id() -> str:
    return f"service-{secrets.token_hex(8)}"


class TokenBrokerAccess:
    """Permissions for the embedded broker: a signed grant. The broker verifies it with the public key."""

    def __init__(self, *, signer: Callable[[], Ed25519PrivateKey], publish: Publish) -> None:
        """``signer`` returns the current signing key; ``publish`` sends revocations."""
        self._signer = signer
        self._publish = publish

    async def issue(self, grant: Grant) -> Credentials:
        """See ``BrokerAccess``. Makes no request."""
        grants.check(grant)
        return Credentials(grant.principal, grants.issue(grant, self._signer()))

    def accepts(self, publish: Sequence[str], subscribe: Sequence[str]) -> bool:  # noqa: ARG002
        """See ``BrokerAccess``. The embedded broker has no limit."""
        return True

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """See ``BrokerAccess``. The broker rejects tokens with an earlier timestamp."""
        check_revocation(client_id, principal)
        message = Control(revoke=Revoke(client_id=client_id, principal=principal, before_s=time.time()))
        try:
            await self._publish(revocation.TOPIC, codec.encode(message))
        except Exception as error:
            raise BrokerAccessError(f"a revocation could not be published to the broker: {error}") from error

    async def expire(self, now_s: float) -> None:
        """Does nothing: the broker disconnects clients whose tokens expire."""

    def service_credentials(self) -> ServiceCredentials:
        client_id = _service_client_id()
        grant = grants.service_grant(client_id=client_id, token_id=secrets.token_hex(16), lifetime_s=_SERVICE_TOKEN_S)
        return ServiceCredentials(
            client_id, grant.principal, grants.issue(grant, self._signer()), float(grant.expires_at)
        )

    async def close(self) -> None:
        """Does nothing."""


class _Response(msgspec.Struct, frozen=True, rename={"request_id": "correlationData"}):
    """The response of the dynamic security plugin to one command."""

    command: str = ""
    request_id: str = ""
    error: str = ""
    data: dict[str, Any] = {}


class _Responses(msgspec.Struct, frozen=True):
    """The responses to all commands of one message."""

    responses: list[_Response]


class MosquittoBrokerAccess:
    """Permissions in mosquitto's dynamic security plugin: for each grant a client with a client id, and a role.

    The username contains principal, client id and expiration, so that any instance finds revoked and expired grants by
    listing usernames. Renewed credentials are a new client: the plugin disconnects a client whose password changes.
    ``mosquitto_clients`` limits their number.
    """

    def __init__(
        self, *, host: str, port: int, username: str, password_file: Path, tls: ssl.SSLContext | None = None
    ) -> None:
        """``username`` is the functions' client in the broker's configuration."""
        self._username = username
        self._password_file = password_file
        self._quota = ClientQuota()
        self._control = _ControlConnection(host, port, tls)

    async def issue(self, grant: Grant) -> Credentials:
        """See ``BrokerAccess``. One message creates the role and the client; a second one deletes replaced clients."""
        grants.check(grant)
        issued = mosquitto_clients.name(grant)
        username = issued.username
        password = secrets.token_urlsafe(32)
        role = {"command": "createRole", "rolename": username, "acls": _acls(grant)}
        client = {
            "command": "createClient",
            "username": username,
            "password": password,
            "clientid": grant.client_id,
            "roles": [{"rolename": username}],
        }
        for response in await self._execute([role, client]):
            if response.error:
                await self._delete([username])
                raise BrokerAccessError(f"mosquitto rejected {response.command}: {response.error}")
        await self._delete(self._quota.add(issued, time.time()))
        return Credentials(username, password)

    def accepts(self, publish: Sequence[str], subscribe: Sequence[str]) -> bool:  # noqa: ARG002
        """See ``BrokerAccess``. Roles have no limit."""
        return True

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """See ``BrokerAccess``. Mosquitto disconnects a deleted client."""
        check_revocation(client_id, principal)
        entries = await self._entries()
        await self._delete(
            [
                entry.username
                for entry in entries
                if entry.client_id == client_id or principal in grants.covering(entry.principal)
            ]
        )

    async def expire(self, now_s: float) -> None:
        await self._delete([entry.username for entry in await self._entries() if entry.expires_at <= now_s])

    def service_credentials(self) -> ServiceCredentials:
        """See ``BrokerAccess``. The functions' client in mosquitto, with a new client id for each call."""
        try:
            password = self._password_file.read_text().strip()
        except OSError as error:
            raise BrokerAccessError(
                f"cannot read mosquitto's service password in {self._password_file}: {error.strerror}; "
                "start the broker with `python -m infra.mosquitto` first"
            ) from error
        return ServiceCredentials(_service_client_id(), self._username, password, math.inf)

    async def close(self) -> None:
        await self._control.close()

    async def _entries(self) -> list[IssuedClient]:
        """All clients that ``issue`` created in any instance."""
        response = (await self._execute([{"command": "listClients", "verbose": False, "count": -1, "offset": 0}]))[0]
        if response.error:
            raise BrokerAccessError(f"mosquitto rejected listClients: {response.error}")
        parsed = (mosquitto_clients.parse(username) for username in response.data.get("clients", []))
        return [client for client in parsed if client is not None]

    async def _delete(self, usernames: list[str]) -> None:
        """Delete clients and their roles. No error if another instance has deleted them."""
        self._quota.remove(usernames)
        commands: list[Mapping[str, Any]] = []
        for username in usernames:
            commands += [
                {"command": "deleteClient", "username": username},
                {"command": "deleteRole", "rolename": username},
            ]
        for start in range(0, len(commands), _MAX_COMMANDS):
            for response in await self._execute(commands[start : start + _MAX_COMMANDS]):
                if response.error and "not found" not in response.error:
                    raise BrokerAccessError(f"mosquitto rejected {response.command}: {response.error}")

    async def _execute(self, commands: Sequence[Mapping[str, Any]]) -> list[_Response]:
        return await self._control.execute(self.service_credentials, commands)


class _ControlConnection:
    """A persistent connection to the dynamic security plugin. Connects on demand, also after a disconnection."""

    def __init__(self, host: str, port: int, tls: ssl.SSLContext | None) -> None:
        self._tls = tls
        self._host = host
        self._port = port
        self._client: paho.Client | None = None
        self._opening = asyncio.Lock()
        self._waiting: dict[str, asyncio.Future[_Responses]] = {}

    async def execute(
        self, service: Callable[[], ServiceCredentials], commands: Sequence[Mapping[str, Any]]
    ) -> list[_Response]:
        """Execute commands and return their responses, in order.

        Raises:
            BrokerAccessError: No connection or no response in time; the commands may have been executed.
        """
        loop = asyncio.get_running_loop()
        request_id = secrets.token_hex(8)
        payload = msgspec.json.encode({"commands": [{**each, "correlationData": request_id} for each in commands]})
        try:
            async with asyncio.timeout(_TIMEOUT_S):
                async with self._opening:
                    if self._client is None or not self._client.is_connected():
                        await self._open(service())
                self._waiting[request_id] = loop.create_future()
                if self._client is not None:
                    self._client.publish(_SECURITY, payload, qos=1)
                responses = (await self._waiting[request_id]).responses
        except TimeoutError as error:
            await self.close()
            raise BrokerAccessError(
                f"mosquitto at {self._host}:{self._port} did not answer in {_TIMEOUT_S} s"
            ) from error
        finally:
            self._waiting.pop(request_id, None)
        if len(responses) != len(commands):
            raise BrokerAccessError(f"mosquitto returned {len(responses)} responses to {len(commands)} commands")
        return responses

    async def close(self) -> None:
        """Disconnect."""
        client, self._client = self._client, None
        if client is not None:
            await close_client(client)

    async def _open(self, service: ServiceCredentials) -> None:
        await self.close()
        loop = asyncio.get_running_loop()
        ready: asyncio.Future[None] = loop.create_future()
        client = paho.Client(
            CallbackAPIVersion.VERSION2, client_id=service.client_id, protocol=paho.MQTTv5, reconnect_on_failure=False
        )
        client.username_pw_set(service.username, service.password)
        if self._tls is not None:
            client.tls_set_context(self._tls)
        client.connect_timeout = _TIMEOUT_S

        def connected(_: Any, __: Any, ___: Any, reason: ReasonCode, ____: Any) -> None:
            if reason.is_failure:
                loop.call_soon_threadsafe(_fail, ready, f"mosquitto rejected the connection of the functions: {reason}")
            else:
                client.subscribe(_RESPONSES, qos=1)

        def subscribed(*_: Any) -> None:
            loop.call_soon_threadsafe(_settle, ready, None)

        def received(_: Any, __: Any, message: paho.MQTTMessage) -> None:
            loop.call_soon_threadsafe(self._receive, message.payload)

        def disconnected(_: Any, __: Any, ___: Any, reason: ReasonCode, ____: Any) -> None:
            loop.call_soon_threadsafe(self._fail_all, ready, f"the connection to mosquitto was lost: {reason}")

        client.on_connect, client.on_subscribe = connected, subscribed
        client.on_message, client.on_disconnect = received, disconnected
        client.on_socket_open = _set_no_delay
        try:
            await asyncio.to_thread(client.connect, self._host, self._port, 30)
        except OSError as error:
            raise BrokerAccessError(f"mosquitto cannot be reached at {self._host}:{self._port}: {error}") from error
        self._client = client
        client.loop_start()
        await ready

    def _receive(self, payload: bytes | bytearray) -> None:
        try:
            message = msgspec.json.decode(payload, type=_Responses)
        except msgspec.MsgspecError:
            return  # not a response; the caller times out and reports it
        request_id = message.responses[0].request_id if message.responses else ""
        if request_id in self._waiting:
            _settle(self._waiting[request_id], message)

    def _fail_all(self, ready: asyncio.Future[None], reason: str) -> None:
        _fail(ready, reason)
        for future in self._waiting.values():
            _fail(future, reason)


def _acls(grant: Grant) -> list[dict[str, Any]]:
    acls = [("publishClientSend", pattern) for pattern in grant.publish]
    for pattern in grant.subscribe:
        acls += [(kind, pattern) for kind in ("subscribePattern", "publishClientReceive")]
    return [{"acltype": kind, "topic": topic, "priority": 0, "allow": True} for kind, topic in acls]


def _set_no_delay(_: Any, __: Any, connection: Any) -> None:
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _settle(future: asyncio.Future[Any], value: Any) -> None:
    if not future.done():
        future.set_result(value)


def _fail(future: asyncio.Future[Any], reason: str) -> None:
    if not future.done():
        future.set_exception(BrokerAccessError(reason))
