"""The functions over real SQLite and a real broker, for tests that are not async; people who use them, and a toy robot.

with Cloud(settings(home, broker)) as cloud:
    anna = cloud.sign_in("anna")
    with cloud.robot() as robot:
        device = robot.pair(anna)
        robot.connect()
"""

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import Callable, Coroutine, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self, TypeVar

import httpx
import jwt

from device_agent.protocol import codec, signing, topics
from device_agent.protocol.messages import (
    Ack,
    AckStatus,
    Command,
    Presence,
    Reason,
    RunMovement,
    State,
    Stop,
    Task,
)
from function_app import bootstrap
from function_app.domain.accounts import Identity
from function_app.domain.ids import agent_id
from function_app.entrypoints.http import create_app
from function_app.entrypoints.ingest import ingest, ingest_telemetry
from function_app.ports.broker_access import Credentials
from function_app.services.identity import ACCESS_S, SESSION_S
from function_app.settings import Settings
from tests.support.brokers import PATIENCE_S, Client, Message, RunningBroker, wait_until

BASE = "http://telescope.test"
API = "/api/v1"
MOVE = {"kind": "move_joints", "position_rad": {"elbow": 1.0}}
"""An action that every robot takes."""

TOKEN_MS = ACCESS_S * 1000

T = TypeVar("T")


class MovingClock:
    """The machine's clock, which a test can put forward."""

    def __init__(self) -> None:
        self.ahead_ms = 0

    def now_ms(self) -> int:
        return time.time_ns() // 1_000_000 + self.ahead_ms

    def advance(self, seconds: float) -> None:
        self.ahead_ms += round(seconds * 1000)


class Cloud:
    """One instance of the functions on an event loop of its own, with the ingest beside it."""

    def __init__(self, settings: Settings, *, clock: MovingClock | None = None) -> None:
        self.clock = clock or MovingClock()
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()
        self.functions = bootstrap.build(settings, clock=self.clock)
        self.app = create_app(self.functions)
        self._feed: asyncio.Future[None] | None = None
        self._telemetry: asyncio.Future[None] | None = None
        self._late: asyncio.Future[None] | None = None
        self._clients: list[httpx.AsyncClient] = []

    def run(self, call: Coroutine[Any, Any, T]) -> T:
        """Run something on the functions' own loop."""
        return asyncio.run_coroutine_threadsafe(call, self.loop).result(4 * PATIENCE_S)

    def client(self, *, address: str = "127.0.0.1", **options: Any) -> httpx.AsyncClient:
        """A new HTTP client with a cookie jar of its own, that asks from ``address``."""
        transport = httpx.ASGITransport(self.app, raise_app_exceptions=False, client=(address, 50_000))
        client = httpx.AsyncClient(transport=transport, base_url=BASE, timeout=PATIENCE_S, **options)
        self._clients.append(client)
        return client

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        """A request of nobody."""
        client = self.client()
        return self.run(client.request(method, path, **options))

    def link(self, name: str) -> str:
        """A one-time sign-in token."""

        async def made() -> str:
            return await self.functions.sign_in.link(await self.functions.sign_in.account(name))

        return self.run(made())

    def sign_in(self, name: str, *, address: str = "127.0.0.1") -> "Person":
        """Somebody in a new sign-in session, who asks from ``address``."""
        answer = self.ask("POST", f"{API}/auth/sign-in", json={"link": self.link(name)})
        assert answer.status_code == 200, answer.text
        return Person(self, answer.json(), address=address)

    def robot(self, *names: str) -> "Robot":
        """An agent that nobody has claimed, with devices of these names (default: ``arm``)."""
        return Robot(self, names or ("arm",))

    def start_ingest(self) -> None:
        """Take in what agents say, until the end; returns once it hears them."""

        async def handle(topic: str, payload: bytes) -> None:
            await ingest(self.functions, topic, payload)

        async def start() -> None:
            self._feed = asyncio.ensure_future(self.functions.feed.run(handle))
            link: Any = self.functions.feed._link  # type: ignore[attr-defined]
            assert await link.ready(PATIENCE_S), link.trouble

        self.run(start())

    def start_telemetry(self) -> None:
        """Take in what robots measure, until the end; returns once it hears them."""

        async def handle(messages: Sequence[tuple[str, bytes]]) -> None:
            await ingest_telemetry(self.functions, messages)

        async def start() -> None:
            self._telemetry = asyncio.ensure_future(self.functions.telemetry.run(handle))
            link: Any = self.functions.telemetry._link  # type: ignore[attr-defined]
            assert await link.ready(PATIENCE_S), link.trouble

        self.run(start())

    def start_late(self) -> None:
        """Take in what robots measured while their link was down, until the end; returns once it hears them."""

        async def handle(messages: Sequence[tuple[str, bytes]]) -> None:
            await ingest_telemetry(self.functions, messages)

        async def start() -> None:
            self._late = asyncio.ensure_future(self.functions.late.run(handle))
            link: Any = self.functions.late._link  # type: ignore[attr-defined]
            assert await link.ready(PATIENCE_S), link.trouble

        self.run(start())

    def sweep(self) -> None:
        """One round of the timer."""
        self.run(self.functions.sweep.run())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        async def end() -> None:
            for feed in (self._feed, self._telemetry, self._late):
                if feed is not None:
                    feed.cancel()
                    await asyncio.gather(feed, return_exceptions=True)
            for client in self._clients:
                await client.aclose()
            await self.functions.close()

        self.run(end())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.run_until_complete(self.loop.shutdown_default_executor())
        self.loop.close()


class Person:
    """An account in one sign-in session, by access token, for which it gets the next one in time."""

    def __init__(self, cloud: Cloud, signed_in: dict[str, Any], *, address: str = "127.0.0.1") -> None:
        self.cloud = cloud
        self.token: str = signed_in["access_token"]
        self.account: str = signed_in["account"]["id"]
        self.name: str = signed_in["account"]["name"]
        self.session: str = signed_in["session"]
        self._given_ms = cloud.clock.now_ms()
        self._client = cloud.client(address=address, headers={"Authorization": f"Bearer {self.token}"})

    def _stay(self) -> None:
        """As a program does that has kept the cookie of its session."""
        now_ms = self.cloud.clock.now_ms()
        if TOKEN_MS // 2 < now_ms - self._given_ms < SESSION_S * 1000:
            who = Identity(self.account, self.name, self.session)
            self.token, self._given_ms = self.cloud.run(self.cloud.functions.sessions.access_token(who)), now_ms
            self._client.headers["Authorization"] = f"Bearer {self.token}"

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        self._stay()
        return self.cloud.run(self._client.request(method, API + path, **options))

    def begin(self, method: str, path: str, **options: Any) -> Callable[[], httpx.Response]:
        """Ask without waiting; call what this gives for the answer."""
        self._stay()
        call = self._client.request(method, API + path, **options)
        future = asyncio.run_coroutine_threadsafe(call, self.cloud.loop)
        return lambda: future.result(4 * PATIENCE_S)

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self.ask("GET", path, **options)

    def post(self, path: str, body: Any = None, **options: Any) -> httpx.Response:
        return self.ask("POST", path, json=body, **options) if body is not None else self.ask("POST", path, **options)

    def put(self, path: str, body: Any) -> httpx.Response:
        return self.ask("PUT", path, json=body)

    def delete(self, path: str) -> httpx.Response:
        return self.ask("DELETE", path)

    def start(self, device: str, **options: Any) -> httpx.Response:
        """Start an action; ``MOVE`` where no ``request`` is given. ``once`` is the idempotency key."""
        headers = {"Idempotency-Key": options.pop("once")} if "once" in options else {}
        return self.post(f"/devices/{device}/actions", {"request": MOVE, **options}, headers=headers)

    def take(self, device: str, **options: Any) -> httpx.Response:
        return self.post(f"/devices/{device}/lease", options)

    def action(self, action: str, **query: Any) -> dict[str, Any]:
        answer = self.get(f"/actions/{action}", params=query)
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return found


Answers = Iterable[AckStatus | Ack]


class Robot:
    """An agent as the protocol says: own key, broker credentials from the API, acks for each signed command.

    A command that comes a second time is answered with the last ack, and not obeyed.

    Attributes:
        reports: What it answers to a new action; a test may put another function here.
        silent: Answers nothing at all.
    """

    def __init__(self, cloud: Cloud, names: tuple[str, ...]) -> None:
        self.cloud = cloud
        self.names = names
        self.key = signing.generate()
        self.public = signing.public_text(self.key.public_key())
        self.id = agent_id(signing.key_id(self.key.public_key()))
        self.devices = [f"{self.id}-{name}" for name in names]
        self.space = ""
        self.session = 0
        self.silent = False
        self.reports: Callable[[Command], Answers] = lambda _: (
            AckStatus.RECEIVED,
            AckStatus.ACCEPTED,
            AckStatus.STARTED,
        )
        self.commands: list[Command] = []
        self.payloads: dict[str, list[bytes]] = {}
        self.stops: list[Stop] = []
        self.link: Client | None = None
        self._keys: dict[str, Any] = {}
        self._sequences: dict[str, int] = {}
        self._said: dict[str, bytes] = {}

    @property
    def device(self) -> str:
        return self.devices[0]

    # ------------------------------------------------------------ HTTP

    def token(self, **changes: Any) -> str:
        """A request token, signed by the agent's own key."""
        key = changes.pop("key", self.key)
        now_s = self.cloud.clock.now_ms() // 1000
        claims = {"iss": "agent", "aud": "telescope/api", "iat": now_s, "exp": now_s + 60, "jti": str(time.time_ns())}
        return jwt.encode(
            {name: value for name, value in {**claims, **changes}.items() if value is not None},
            key,
            "EdDSA",
            headers={"kid": signing.key_id(key.public_key())},
        )

    def ask(self, method: str, path: str, *, token: str = "", **options: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {token or self.token()}"}
        return self.cloud.ask(method, API + path, headers=headers, **options)

    def introduction(self, **changes: Any) -> dict[str, Any]:
        devices = [{"name": name, "kind": "arm", "robot_type": "ur5", "label": name.title()} for name in self.names]
        return {"name": "lab", "public_key": self.public, "software": "toy 1", "devices": devices, **changes}

    def enroll(self, **changes: Any) -> httpx.Response:
        return self.ask("POST", "/agents/enroll", json=self.introduction(**changes))

    def code(self) -> str:
        answer = self.enroll()
        assert answer.status_code == 201, answer.text
        code: str = answer.json()["claim_code"]
        return code

    def enrollment(self, wait_ms: int = 0) -> dict[str, Any]:
        answer = self.ask("GET", "/agents/enrollment", params={"wait_ms": wait_ms})
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return found

    def pair(self, owner: Person) -> str:
        """Enroll and be claimed; gives the first device's id."""
        answer = owner.post("/agents/claim", {"code": self.code()})
        assert answer.status_code == 200, answer.text
        state = self.enrollment()
        self.space = state["space"]
        self._keys = {key["id"]: signing.public_key(key["public"]) for key in state["keys"]}
        return self.device

    # ------------------------------------------------------------ MQTT

    def connect(self) -> Self:
        """Connect with credentials from the API, hear what is addressed to it, and say that it is there."""
        issued = self.ask("POST", "/mqtt/credentials", json={"purpose": "agent"}).json()
        self.session += 1
        self.link = _Link(self, issued).open()
        assert self.link.connected.is_set(), f"refused: {self.link.answer}"
        assert self.link.subscribe(*issued["subscribe"]) == [1] * len(issued["subscribe"])
        self.say_presence(online=True)
        return self

    def topic(self, kind: str, name: str = "") -> str:
        return topics.device(self.space, self.id, name or self.names[0], kind)

    def say(self, topic: str, message: Any, *, retain: bool = False) -> None:
        assert self.link is not None
        self.link.publish_acknowledged(topic, codec.encode(message), retain=retain)

    def say_presence(self, *, online: bool, session: int | None = None) -> None:
        number = self.session if session is None else session
        message = Presence(online=online, session=number, at_ms=self.cloud.clock.now_ms())
        self.say(topics.conn(self.space, self.id), message, retain=True)

    def say_state(self, state: State) -> None:
        self.say(self.topic(topics.STATE), state, retain=True)

    def ack(self, command: str, status: AckStatus, **more: Any) -> Ack:
        sequence = self._sequences[command] = self._sequences.get(command, 0) + 1
        at_ms = self.cloud.clock.now_ms()
        return replace_ack(Ack(id=command, status=status, sequence=sequence, at_ms=at_ms, tick_ms=at_ms), more)

    def report(self, command: str, status: AckStatus, **more: Any) -> Ack:
        """Report about an action, when the test wants it."""
        ack = self.ack(command, status, **more)
        self.say(self.topic(topics.ACK), ack)
        return ack

    def fail(self, command: str, code: str, message: str) -> None:
        self.report(command, AckStatus.FAILED, reason=Reason(code=code, message=message))

    def heard(self, kind: type[T]) -> list[Command]:
        """Signed commands of this kind, in order."""
        return [command for command in self.commands if isinstance(command.request, kind)]

    def obey(self, message: Message) -> None:
        """Called on the connection's own thread."""
        topic = topics.parse(message.topic)
        if topic.kind == topics.STOP:
            self.stops.append(codec.decode(message.payload, Stop))
        if topic.kind != topics.CMD:
            return
        command = codec.decode(signing.verify(message.payload, self._keys), Command)
        seen = self.payloads.setdefault(command.id, [])
        seen.append(message.payload)
        topic_of_acks = topics.device(topic.space, topic.agent, topic.device, topics.ACK)
        if len(seen) > 1:
            if command.id in self._said and not self.silent and self.link is not None:
                self.link.publish(topic_of_acks, self._said[command.id])
            return
        self.commands.append(command)
        if self.silent or self.link is None:
            return
        action = isinstance(command.request, Task | RunMovement)
        for each in self.reports(command) if action else (AckStatus.RECEIVED, AckStatus.DONE):
            ack = each if isinstance(each, Ack) else self.ack(command.id, each)
            self._said[command.id] = codec.encode(ack)
            self.link.publish(topic_of_acks, self._said[command.id])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.link is not None:
            self.link.close()


class _Link(Client):
    """The toy robot's connection: hands each message on at once."""

    def __init__(self, robot: Robot, issued: dict[str, Any]) -> None:
        super().__init__(
            issued["client_id"], Credentials(issued["username"], issued["password"]), port=issued["tcp"]["port"]
        )
        self._robot = robot

    def _on_message(self, *arguments: Any) -> None:
        super()._on_message(*arguments)
        self._robot.obey(self.messages.queue[-1])


def replace_ack(ack: Ack, changes: dict[str, Any]) -> Ack:
    return codec.decode(json.dumps({**json.loads(codec.encode(ack)), **_plain(changes)}).encode(), Ack)


def _plain(changes: dict[str, Any]) -> dict[str, Any]:
    return {name: json.loads(codec.encode(value)) for name, value in changes.items()}


def settings(home: Path, broker: RunningBroker | None = None, **changes: Any) -> Settings:
    """Settings of functions with this home, at this broker (``None``: at no broker).

    Requests are counted only where a test asks for it: all of a test's people share one address.
    """
    rates = dict.fromkeys(("rate_address", "rate_account", "rate_key", "rate_agent"), 0)
    known = Settings(home=home, public_url=BASE, mqtt_port=1, **{**rates, **changes})
    if broker is None:
        return known
    return replace(
        known, broker=broker.kind, mqtt_port=broker.tcp_port, websocket_url=f"ws://127.0.0.1:{broker.websocket_port}"
    )


def problem(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    """The body of a refusal, once it is seen to be a proper one."""
    assert answer.status_code == status, f"{answer.status_code} {answer.text}"
    assert answer.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = answer.json()
    assert body["type"] == f"/problems/{code}", body
    assert body["status"] == status
    assert body["title"]
    assert body["detail"].endswith((".", "…"))
    assert "Traceback" not in answer.text
    return body


@contextlib.contextmanager
def paired(cloud: Cloud, owner: str = "anna", *names: str) -> Iterator[tuple[Person, Robot]]:
    """Somebody with a robot that is connected and known to be online."""
    person = cloud.sign_in(owner)
    with cloud.robot(*names) as robot:
        robot.pair(person)
        robot.connect()
        wait_until(lambda: person.get(f"/devices/{robot.device}").json()["online"], "the robot to be online")
        yield person, robot
