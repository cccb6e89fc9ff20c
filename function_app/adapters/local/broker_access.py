"""Broker rights: signed tokens for the embedded broker, clients and roles written into a site's mosquitto."""

import asyncio
import math
import secrets
import socket
import ssl
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import paho.mqtt.client as paho
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.reasoncodes import ReasonCode

from device_agent.protocol import codec
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.security import grants, revocation
from device_agent.protocol.security.grants import Grant
from device_agent.protocol.security.revocation import Control, Revoke
from function_app.ports.broker_access import BrokerAccessError, Credentials, ServiceCredentials, check_revocation

Publish = Callable[[str, bytes], Awaitable[None]]
"""Publishes as a service at QoS 1 and returns once the broker has acknowledged; raises when it has not."""

_SERVICE_TOKEN_S = 24 * 3_600.0
_SECURITY = "$CONTROL/dynamic-security/v1"
_ANSWERS = f"{_SECURITY}/response"
_ANSWER_S = 10.0
_COMMANDS_AT_ONCE = 100


def _service_client_id() -> str:
    return f"service-{secrets.token_hex(8)}"


class TokenBrokerAccess:
    """Rights for the embedded broker: the grant itself, signed. The broker needs the public key alone."""

    def __init__(self, *, signer: Callable[[], Ed25519PrivateKey], publish: Publish) -> None:
        """``signer`` returns the current key, which the broker knows; ``publish`` sends revocations."""
        self._signer = signer
        self._publish = publish

    async def issue(self, grant: Grant) -> Credentials:
        """As the port says; no broker is asked."""
        grants.check(grant)
        return Credentials(grant.principal, grants.issue(grant, self._signer()))

    def accepts(self, publish: Sequence[str], subscribe: Sequence[str]) -> bool:  # noqa: ARG002
        """As the port says: a token has no bound of its own."""
        return True

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """As the port says; tokens made until now are refused, by the clock that stamps them."""
        check_revocation(client_id, principal)
        message = Control(revoke=Revoke(client_id=client_id, principal=principal, before_s=time.time()))
        try:
            await self._publish(revocation.TOPIC, codec.encode(message))
        except Exception as error:
            raise BrokerAccessError(f"the broker could not be told of a revocation: {error}") from error

    async def expire(self, now_s: float) -> None:
        """Nothing: the broker ends connections with their tokens."""

    def service_credentials(self) -> ServiceCredentials:
        client_id = _service_client_id()
        grant = grants.service_grant(client_id=client_id, token_id=secrets.token_hex(16), lifetime_s=_SERVICE_TOKEN_S)
        return ServiceCredentials(
            client_id, grant.principal, grants.issue(grant, self._signer()), float(grant.expires_at)
        )

    async def close(self) -> None:
        """Nothing is open."""


class _Entry(NamedTuple):
    """What a user name in mosquitto says; the role of the same name holds its topics."""

    username: str
    principal: str
    client_id: str
    expires_at: int


class _Answer(msgspec.Struct, frozen=True, rename={"question": "correlationData"}):
    """One answer of the dynamic security plugin."""

    command: str = ""
    question: str = ""
    error: str = ""
    data: dict[str, Any] = {}


class _Answers(msgspec.Struct, frozen=True):
    """All answers to one message."""

    responses: list[_Answer]


class MosquittoBrokerAccess:
    """Rights in mosquitto's dynamic security: for each grant a client bound to the client id, and a role of its own.

    The user name says all there is to know, ``principal/client id/end/token id``, so that any instance can find what to
    revoke and what has run out by listing names, and renewing an agent's credentials does not touch its connection
    (the plugin cuts a client whose password is changed).
    """

    def __init__(
        self, *, host: str, port: int, username: str, password_file: Path, tls: ssl.SSLContext | None = None
    ) -> None:
        """``username`` is the client that the broker's configuration made for the functions."""
        self._username = username
        self._password_file = password_file
        self._line = _ControlLine(host, port, tls)

    async def issue(self, grant: Grant) -> Credentials:
        """As the port says; role and client are made in one message, the role first."""
        grants.check(grant)
        if "/" in grant.principal or "/" in grant.token_id:
            raise ProtocolError("a principal and a token id have no slash")
        username = "/".join((grant.principal, grant.client_id, str(grant.expires_at), grant.token_id))
        password = secrets.token_urlsafe(32)
        role = {"command": "createRole", "rolename": username, "acls": _acls(grant)}
        client = {
            "command": "createClient",
            "username": username,
            "password": password,
            "clientid": grant.client_id,
            "roles": [{"rolename": username}],
        }
        for answer in await self._ask([role, client]):
            if answer.error:
                await self._delete([username])
                raise BrokerAccessError(f"mosquitto refused to {answer.command}: {answer.error}")
        return Credentials(username, password)

    def accepts(self, publish: Sequence[str], subscribe: Sequence[str]) -> bool:  # noqa: ARG002
        """As the port says: a role has none."""
        return True

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """As the port says; deleting a client cuts its connection."""
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
        """As the port says; mosquitto's own client for the functions, with another client id each time."""
        try:
            password = self._password_file.read_text().strip()
        except OSError as error:
            raise BrokerAccessError(
                f"cannot read mosquitto's service password in {self._password_file}: {error.strerror}; "
                "start the broker with `python -m infra.mosquitto` first"
            ) from error
        return ServiceCredentials(_service_client_id(), self._username, password, math.inf)

    async def close(self) -> None:
        await self._line.close()

    async def _entries(self) -> list[_Entry]:
        """Every client that ``issue`` made, by any instance."""
        answer = (await self._ask([{"command": "listClients", "verbose": False, "count": -1, "offset": 0}]))[0]
        if answer.error:
            raise BrokerAccessError(f"mosquitto refused to list its clients: {answer.error}")
        entries = []
        for username in answer.data.get("clients", []):
            match username.split("/"):
                case [principal, client_id, end, _] if end.isdecimal():
                    entries.append(_Entry(username, principal, client_id, int(end)))
        return entries

    async def _delete(self, usernames: list[str]) -> None:
        """Delete clients and their roles; those that are gone already, by another instance, are no error."""
        commands: list[Mapping[str, Any]] = []
        for username in usernames:
            commands += [
                {"command": "deleteClient", "username": username},
                {"command": "deleteRole", "rolename": username},
            ]
        for start in range(0, len(commands), _COMMANDS_AT_ONCE):
            for answer in await self._ask(commands[start : start + _COMMANDS_AT_ONCE]):
                if answer.error and "not found" not in answer.error:
                    raise BrokerAccessError(f"mosquitto refused to {answer.command}: {answer.error}")

    async def _ask(self, commands: Sequence[Mapping[str, Any]]) -> list[_Answer]:
        return await self._line.ask(self.service_credentials, commands)


class _ControlLine:
    """One warm connection to the dynamic security plugin, made when it is needed and made anew after it broke."""

    def __init__(self, host: str, port: int, tls: ssl.SSLContext | None) -> None:
        self._tls = tls
        self._host = host
        self._port = port
        self._client: paho.Client | None = None
        self._opening = asyncio.Lock()
        self._waiting: dict[str, asyncio.Future[_Answers]] = {}

    async def ask(
        self, service: Callable[[], ServiceCredentials], commands: Sequence[Mapping[str, Any]]
    ) -> list[_Answer]:
        """The answers to some commands, in their order.

        Raises:
            BrokerAccessError: No connection, or no answer in time; the commands may have been executed.
        """
        loop = asyncio.get_running_loop()
        question = secrets.token_hex(8)
        payload = msgspec.json.encode({"commands": [{**each, "correlationData": question} for each in commands]})
        try:
            async with asyncio.timeout(_ANSWER_S):
                async with self._opening:
                    if self._client is None or not self._client.is_connected():
                        await self._open(service())
                self._waiting[question] = loop.create_future()
                if self._client is not None:
                    self._client.publish(_SECURITY, payload, qos=1)
                answers = (await self._waiting[question]).responses
        except TimeoutError as error:
            await self.close()
            raise BrokerAccessError(
                f"mosquitto at {self._host}:{self._port} did not answer in {_ANSWER_S} s"
            ) from error
        finally:
            self._waiting.pop(question, None)
        if len(answers) != len(commands):
            raise BrokerAccessError(f"mosquitto gave {len(answers)} answers to {len(commands)} commands")
        return answers

    async def close(self) -> None:
        """Disconnect."""
        client, self._client = self._client, None
        if client is not None:
            client.disconnect()
            await asyncio.to_thread(client.loop_stop)

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
        client.connect_timeout = _ANSWER_S

        def connected(_: Any, __: Any, ___: Any, reason: ReasonCode, ____: Any) -> None:
            if reason.is_failure:
                loop.call_soon_threadsafe(_fail, ready, f"mosquitto refuses the functions: {reason}")
            else:
                client.subscribe(_ANSWERS, qos=1)

        def subscribed(*_: Any) -> None:
            loop.call_soon_threadsafe(_settle, ready, None)

        def answered(_: Any, __: Any, message: paho.MQTTMessage) -> None:
            loop.call_soon_threadsafe(self._take, message.payload)

        def disconnected(_: Any, __: Any, ___: Any, reason: ReasonCode, ____: Any) -> None:
            loop.call_soon_threadsafe(self._broken, ready, f"the connection to mosquitto broke: {reason}")

        client.on_connect, client.on_subscribe = connected, subscribed
        client.on_message, client.on_disconnect = answered, disconnected
        client.on_socket_open = _send_at_once
        try:
            await asyncio.to_thread(client.connect, self._host, self._port, 30)
        except OSError as error:
            raise BrokerAccessError(f"mosquitto cannot be reached at {self._host}:{self._port}: {error}") from error
        self._client = client
        client.loop_start()
        await ready

    def _take(self, payload: bytes | bytearray) -> None:
        try:
            answers = msgspec.json.decode(payload, type=_Answers)
        except msgspec.MsgspecError:
            return  # not a response; the caller times out and reports it
        question = answers.responses[0].question if answers.responses else ""
        if question in self._waiting:
            _settle(self._waiting[question], answers)

    def _broken(self, ready: asyncio.Future[None], why: str) -> None:
        _fail(ready, why)
        for future in self._waiting.values():
            _fail(future, why)


def _acls(grant: Grant) -> list[dict[str, Any]]:
    acls = [("publishClientSend", pattern) for pattern in grant.publish]
    for pattern in grant.subscribe:
        acls += [(kind, pattern) for kind in ("subscribePattern", "publishClientReceive")]
    return [{"acltype": kind, "topic": topic, "priority": 0, "allow": True} for kind, topic in acls]


def _send_at_once(_: Any, __: Any, opened: Any) -> None:
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _settle(future: asyncio.Future[Any], value: Any) -> None:
    if not future.done():
        future.set_result(value)


def _fail(future: asyncio.Future[Any], why: str) -> None:
    if not future.done():
        future.set_exception(BrokerAccessError(why))
