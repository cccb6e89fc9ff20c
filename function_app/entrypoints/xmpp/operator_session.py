"""The session of one operator at the gateway: calls of the HTTP API, live data and setpoints over XMPP.

The gateway decides nothing. Calls go to the HTTP API with the operator's own token. Messages pass broker connections
with the credentials that the API issues to this token. Roles, leases, epochs and rate limits are therefore those of the
other transports.
"""

import asyncio
import json
import time
from collections.abc import Coroutine
from datetime import datetime
from typing import Any

import httpx

from device_agent.protocol import topics
from device_agent.protocol.xmpp import operator_stanzas, stanzas
from device_agent.protocol.xmpp.operator_stanzas import Call, Listen, SignIn
from device_agent.protocol.xmpp.stanzas import Delivery
from function_app.domain.common.ids import device_id
from function_app.ports.broker_access import BrokerAccessError, ServiceCredentials
from function_app.ports.broker_link import BrokerLink, OpenLink
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.xmpp_connection import XmppConnection

API = "/api/v1/"
MAX_REQUESTS = 16
"""Requests in progress; Stop is not limited."""
MAX_STREAMS = 16
"""Devices that one operator controls at the same time."""
_CREDENTIALS = f"{API}mqtt/credentials"
_EXCLUDED = (f"{API}auth", f"{API}xmpp")
"""Paths that need an address or a cookie of the caller."""
_OK = 200
_RETRY_S = 1.0
"""After a refusal, setpoints of the same lease are dropped for this time [s]."""
_MIN_LIFETIME_S = 60.0
"""Credentials that end earlier are used until the broker ends them, and are not renewed before [s]."""


class OperatorSession:
    """The session of one operator.

    Args:
        connection: Connection to the XMPP server.
        api: The HTTP API, in this process.
        open_link: Opens a broker connection.
        jid: Full JID of the operator.
        account: The account that the XMPP server has authenticated.
    """

    def __init__(
        self, connection: XmppConnection, api: httpx.AsyncClient, open_link: OpenLink, *, jid: str, account: str
    ) -> None:
        self.jid = jid
        self._connection = connection
        self._api = api
        self._open_link = open_link
        self._principal = f"account:{account}:"
        self._token = ""
        self._link: BrokerLink | None = None
        self._allowed: tuple[str, ...] = ()
        self._listening: tuple[str, ...] = ()
        self._streams: dict[str, _SetpointStream] = {}
        self._refused_s: dict[str, float] = {}
        self._requests: set[asyncio.Task[None]] = set()
        self._ending: set[asyncio.Task[None]] = set()

    def receive(self, request: SignIn | Call | Listen) -> None:
        """Start to answer a request."""
        is_stop = isinstance(request, Call) and request.path.partition("?")[0].endswith("/stop")
        if len(self._requests) >= MAX_REQUESTS and not is_stop:
            self._reject(request.id, 429, f"At most {MAX_REQUESTS} requests may be in progress. Wait for answers.")
        elif not self._token and not isinstance(request, SignIn):
            self._reject(request.id, 401, "Sign in first.")
        else:
            _start(self._answer(request), self._requests)

    def receive_setpoint(self, delivery: Delivery) -> None:
        """Publish a setpoint; a newer one replaces it while the broker connection is being opened."""
        topic = topics.parse(delivery.topic)
        if topic.kind != topics.CTL or not topic.name.isdecimal() or not self._token:
            reason = "Operators publish setpoints only, after they have signed in."
            self._connection.send(stanzas.rejection(self.jid, delivery.id or topic.kind, reason))
            return
        if time.monotonic() - self._refused_s.get(delivery.topic, float("-inf")) < _RETRY_S:
            return
        stream = self._streams.get(delivery.topic)
        if stream is None:
            while len(self._streams) >= MAX_STREAMS:
                self._end_stream(next(iter(self._streams)))
            stream = self._streams[delivery.topic] = self._open_stream(delivery.topic, topic)
        stream.send(delivery.payload)

    async def close(self) -> None:
        """End the session. Leases stay valid until they expire; devices hold without setpoints."""
        for task in self._requests:
            task.cancel()
        await asyncio.gather(*self._requests, return_exceptions=True)
        for topic in list(self._streams):
            self._end_stream(topic)
        await asyncio.gather(*self._ending)
        if self._link is not None:
            await self._link.close()

    # ------------------------------------------------------------ requests

    async def _answer(self, request: SignIn | Call | Listen) -> None:
        match request:
            case SignIn():
                await self._sign_in(request)
            case Call():
                await self._call(request)
            case Listen():
                await self._listen(request)

    async def _sign_in(self, request: SignIn) -> None:
        status, text = await self._request("POST", _CREDENTIALS, b'{"purpose":"view"}', token=request.token)
        if status != _OK:
            self._connection.send(operator_stanzas.answer(self.jid, request.id, status, text))
            return
        issued = json.loads(text)
        if not issued["username"].startswith(self._principal):
            self._reject(request.id, 403, "The token belongs to another account than this XMPP user.")
            return
        self._token = request.token
        allowed = tuple(issued["subscribe"])
        if self._link is None or set(allowed) != set(self._allowed):
            self._allowed = allowed
            await self._open_view()
        self._connection.send(operator_stanzas.answer(self.jid, request.id, 204))

    async def _call(self, request: Call) -> None:
        if not request.path.startswith(API) or request.path.startswith(_EXCLUDED):
            self._reject(request.id, 404, f"Calls over XMPP start with {API}, except sign-in and XMPP credentials.")
            return
        status, text = await self._request(request.method, request.path, request.body)
        if len(text.encode()) > operator_stanzas.MAX_ANSWER_BYTES:
            self._reject(request.id, 413, "The answer is too long for XMPP. Request a smaller page (limit=…).")
        else:
            self._connection.send(operator_stanzas.answer(self.jid, request.id, status, text))

    async def _listen(self, request: Listen) -> None:
        refused = [topic for topic in request.topics if not self._may_receive(topic)]
        if refused:
            self._reject(request.id, 403, f"This account may not receive {refused[0]}.")
            return
        assert self._link is not None  # noqa: S101 (opened at the sign-in)
        before, self._listening = self._listening, request.topics
        self._link.unsubscribe([topic for topic in before if topic not in request.topics])
        await self._link.subscribe([topic for topic in request.topics if topic not in before])
        self._connection.send(operator_stanzas.answer(self.jid, request.id, 204))

    def _reject(self, request_id: str, status: int, detail: str) -> None:
        self._connection.send(operator_stanzas.problem(self.jid, request_id, status, detail))

    async def _request(self, method: str, path: str, body: bytes, *, token: str = "") -> tuple[int, str]:
        """Status and body of a response of the HTTP API; a body that is not JSON is replaced by a problem."""
        headers = {"Authorization": f"Bearer {token or self._token}"} | (
            {"Content-Type": "application/json"} if body else {}
        )
        try:
            response = await self._api.request(method, path, content=body, headers=headers)
        except httpx.HTTPError as error:
            return 503, json.dumps({"status": 503, "detail": f"The API did not answer: {type(error).__name__}."})
        kind = response.headers.get("content-type", "")
        if response.content and "json" not in kind:
            return 406, json.dumps({"status": 406, "detail": f"XMPP does not carry {kind}. Request it over HTTP."})
        return response.status_code, response.text

    # ------------------------------------------------------------ broker

    async def _open_view(self) -> None:
        """Open the connection for live data; replaces the previous one, whose credentials cover other devices."""
        if self._link is not None:
            await self._link.close()
        self._link = self._open_link(self._view_credentials, self._forward)
        await self._link.subscribe(self._listening)

    async def _view_credentials(self) -> ServiceCredentials:
        issued, credentials = await self._credentials({"purpose": "view"})
        self._allowed = tuple(issued["subscribe"])
        ended = [topic for topic in self._listening if not self._may_receive(topic)]
        if ended and self._link is not None:  # a share has ended; the broker would reject all subscriptions
            self._link.unsubscribe(ended)
            self._listening = tuple(topic for topic in self._listening if topic not in ended)
        return credentials

    def _may_receive(self, topic: str) -> bool:
        return any(topics.matches(pattern, topic) for pattern in self._allowed)

    async def _credentials(self, purpose: dict[str, Any]) -> tuple[dict[str, Any], ServiceCredentials]:
        status, text = await self._request("POST", _CREDENTIALS, json.dumps(purpose).encode())
        issued: dict[str, Any] = json.loads(text)
        if status != _OK:
            raise BrokerAccessError(str(issued.get("detail", status)))
        ends_s = max(datetime.fromisoformat(issued["expires_at"]).timestamp(), time.time() + _MIN_LIFETIME_S)
        return issued, ServiceCredentials(issued["client_id"], issued["username"], issued["password"], ends_s)

    def _forward(self, topic: str, payload: bytes) -> None:
        if f"/{topics.TELE}/" in topic and self._connection.congested():
            return  # a newer measurement follows
        self._connection.send(stanzas.message(self.jid, topic, payload))

    def _open_stream(self, text: str, topic: topics.Topic) -> "_SetpointStream":
        purpose = {"purpose": "control", "device": device_id(topic.agent, topic.device), "epoch": int(topic.name)}

        async def credentials() -> ServiceCredentials:
            try:
                return (await self._credentials(purpose))[1]
            except BrokerAccessError as error:
                self._connection.send(stanzas.rejection(self.jid, topics.CTL, str(error)))
                self._refused_s = {text: time.monotonic()}
                self._end_stream(text)
                raise

        return _SetpointStream(text, self._open_link(credentials, lambda _topic, _payload: None))

    def _end_stream(self, topic: str) -> None:
        if (stream := self._streams.pop(topic, None)) is not None:
            _start(stream.close(), self._ending)


class _SetpointStream:
    """Publishes the newest setpoint of one lease."""

    def __init__(self, topic: str, link: BrokerLink) -> None:
        self._topic = topic
        self._link = link
        self._newest: asyncio.Queue[bytes] = asyncio.Queue(1)
        self._task = asyncio.create_task(self._run())

    def send(self, payload: bytes) -> None:
        if self._newest.full():
            self._newest.get_nowait()
        self._newest.put_nowait(payload)

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await self._link.close()

    async def _run(self) -> None:
        while True:
            payload = await self._newest.get()
            try:
                await self._link.publish(self._topic, payload, 0)
            except BusUnavailable:
                continue  # the connection is opened again; without permission the stream has been closed


def _start(work: Coroutine[None, None, None], tasks: set[asyncio.Task[None]]) -> None:
    task = asyncio.create_task(work)
    tasks.add(task)
    task.add_done_callback(tasks.discard)
