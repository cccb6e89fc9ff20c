"""The functions for synchronous tests, over SQLite and a real broker or over fakes, and people who use them.

with Cloud(settings(home, broker)) as cloud:
    anna = cloud.sign_in("anna")
    with cloud.robot() as robot:
        device = robot.pair(anna)
        robot.connect()
"""

import asyncio
import contextlib
import threading
from collections.abc import Callable, Coroutine, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar, cast

import httpx

from function_app import bootstrap
from function_app.domain.identity.accounts import Identity
from function_app.entrypoints.http import create_app
from function_app.entrypoints.ingest.router import ingest, ingest_telemetry
from function_app.ports.broker_access import Credentials
from function_app.ports.tables import Tables
from function_app.services.identity.authenticator import ACCESS_S, SESSION_S
from function_app.settings import RateLimits, Settings
from tests.fakes.agent import Robot
from tests.fakes.clock import MovingClock
from tests.harness.cloud.memory import Memory, SharedApp
from tests.harness.network.brokers import PATIENCE_S, Client, Message, RunningBroker, wait_until

if TYPE_CHECKING:
    from fastapi import FastAPI

BASE = "http://telescope.test"
API = "/api/v1"
MOVE = {"kind": "move_joints", "position_rad": {"elbow": 1.0}}
"""A request that every robot accepts."""

TOKEN_MS = ACCESS_S * 1000

T = TypeVar("T")


def connect_to_broker(issued: dict[str, Any], *, on_message: Callable[[Message], None] | None = None) -> Client:
    """A connection to a real broker with credentials that the API issued."""
    credentials = Credentials(issued["username"], issued["password"])
    return Client(issued["client_id"], credentials, port=issued["tcp"]["port"], on_message=on_message).open()


class Cloud:
    """One instance of the functions, with its ingest.

    With ``memory`` it uses fakes and runs in the thread of the test; a call returns when all its effects are stored.
    Otherwise it uses the adapters of the settings and runs on an event loop in a separate thread.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        clock: MovingClock | None = None,
        memory: Memory | None = None,
        tables: Tables | None = None,
    ) -> None:
        self.memory = memory
        self.clock = clock or (MovingClock() if memory is None else memory.clock)
        self._feeds: list[asyncio.Future[None]] = []
        self._clients: list[httpx.AsyncClient] = []
        if memory is None:
            self.loop: asyncio.AbstractEventLoop = asyncio.new_event_loop()
            self._thread = threading.Thread(target=self.loop.run_forever)
            self._thread.start()
            self.functions = bootstrap.build(settings, clock=self.clock)
            self.app: FastAPI | SharedApp = create_app(self.functions)
        else:
            self.loop = memory.loop
            self.functions = bootstrap.build(settings, clock=self.clock, adapters=memory.adapters(settings, tables))
            self.app = SharedApp(self.functions)

    def run(self, call: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine on the event loop of the functions."""
        if self.memory is None:
            return asyncio.run_coroutine_threadsafe(call, self.loop).result(4 * PATIENCE_S)
        self.memory.clock.advance(0.001)
        result = self.loop.run_until_complete(call)
        self.settle()
        return result

    def begin(self, call: Coroutine[Any, Any, T]) -> Callable[[], T]:
        """Start a coroutine. Returns a function that waits for its result."""
        if self.memory is None:
            future = asyncio.run_coroutine_threadsafe(call, self.loop)
            return lambda: future.result(4 * PATIENCE_S)
        task = self.loop.create_task(call)
        self.settle()
        return lambda: self.run(_result(task))

    def settle(self) -> None:
        """With ``memory``: run all ready tasks until every published message is stored."""
        if self.memory is not None:
            self.memory.settle()

    def connect(self, issued: dict[str, Any], *, on_message: Callable[[Message], None] | None = None) -> Client:
        """A connection to the broker with credentials that the API issued."""
        if self.memory is None:
            return connect_to_broker(issued, on_message=on_message)
        credentials = Credentials(issued["username"], issued["password"])
        connection = self.memory.broker.connect(issued["client_id"], credentials, on_message=on_message)
        return cast("Client", connection)

    def client(self, *, address: str = "127.0.0.1", **options: Any) -> httpx.AsyncClient:
        """A new HTTP client with separate cookies whose requests come from ``address``."""
        transport = httpx.ASGITransport(self.app, raise_app_exceptions=False, client=(address, 50_000))
        client = httpx.AsyncClient(transport=transport, base_url=BASE, timeout=PATIENCE_S, **options)
        self._clients.append(client)
        return client

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send a request without credentials."""
        client = self.client()
        return self.run(client.request(method, path, **options))

    def link(self, name: str) -> str:
        """A one-time sign-in token."""

        async def create() -> str:
            return await self.functions.sign_in.link(await self.functions.sign_in.account(name))

        return self.run(create())

    def sign_in(self, name: str, *, address: str = "127.0.0.1") -> "Person":
        """Returns a person in a new sign-in session whose requests come from ``address``."""
        answer = self.request("POST", f"{API}/auth/sign-in", json={"link": self.link(name)})
        assert answer.status_code == 200, answer.text
        return Person(self, answer.json(), address=address)

    def robot(self, *names: str) -> Robot:
        """An unclaimed agent with devices of these names (default: ``arm``)."""
        return Robot(self, names or ("arm",))

    def start_ingest(self) -> None:
        """Process messages of agents until the end; returns when it is subscribed."""

        async def handle(topic: str, payload: bytes) -> None:
            await ingest(self.functions, topic, payload)
            await self.functions.confirmations.publish([(topic, payload)])

        self._run_feed(self.functions.feed, handle)

    def stop_ingest(self) -> None:
        """Process no more messages of agents, like a killed worker."""

        async def stop() -> None:
            feeds, self._feeds = self._feeds, []
            for feed in feeds:
                feed.cancel()
            await asyncio.gather(*feeds, return_exceptions=True)

        self.run(stop())

    def start_telemetry(self) -> None:
        """Process live measurements until the end; returns when it is subscribed."""
        self._run_feed(self.functions.telemetry, self._store)

    def start_late(self) -> None:
        """Process measurements that agents buffered while offline; returns when it is subscribed."""
        self._run_feed(self.functions.late, self._store)

    async def _store(self, messages: Sequence[tuple[str, bytes]]) -> None:
        await ingest_telemetry(self.functions, messages)
        await self.functions.confirmations.publish(messages)

    def _run_feed(self, feed: Any, handle: Callable[..., Coroutine[Any, Any, None]]) -> None:
        async def start() -> None:
            self._feeds.append(asyncio.ensure_future(feed.run(handle)))
            if self.memory is None:
                assert await feed._connection.ready(PATIENCE_S), feed._connection.problem
            else:
                await asyncio.sleep(0)

        self.run(start())

    def sweep(self) -> None:
        """Run the due jobs of the timer once."""
        self.run(self.functions.scheduler.run_due_jobs())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        async def end() -> None:
            for feed in self._feeds:
                feed.cancel()
                await asyncio.gather(feed, return_exceptions=True)
            for client in self._clients:
                await client.aclose()
            await self.functions.close()

        self.run(end())
        if self.memory is not None:
            return
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.run_until_complete(self.loop.shutdown_default_executor())
        self.loop.close()


async def _result(task: asyncio.Task[T]) -> T:
    return await task


class Person:
    """An account in one sign-in session; renews its access token in time."""

    def __init__(self, cloud: Cloud, signed_in: dict[str, Any], *, address: str = "127.0.0.1") -> None:
        self.cloud = cloud
        self.token: str = signed_in["access_token"]
        self.account: str = signed_in["account"]["id"]
        self.name: str = signed_in["account"]["name"]
        self.session: str = signed_in["session"]
        self._issued_ms = cloud.clock.now_ms()
        self._client = cloud.client(address=address, headers={"Authorization": f"Bearer {self.token}"})

    def _renew_token(self) -> None:
        """Renew the access token, as a program with the cookie of its session does."""
        now_ms = self.cloud.clock.now_ms()
        if TOKEN_MS // 2 < now_ms - self._issued_ms < SESSION_S * 1000:
            identity = Identity(self.account, self.name, self.session)
            self.token, _ = self.cloud.run(self.cloud.functions.sessions.access_token(identity))
            self._issued_ms = now_ms
            self._client.headers["Authorization"] = f"Bearer {self.token}"

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        self._renew_token()
        return self.cloud.run(self._client.request(method, API + path, **options))

    def begin(self, method: str, path: str, **options: Any) -> Callable[[], httpx.Response]:
        """Start a request. Returns a function that waits for the response."""
        self._renew_token()
        call = self._client.request(method, API + path, **options)
        return self.cloud.begin(call)

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self.request("GET", path, **options)

    def each_page(self, path: str, **query: Any) -> list[list[dict[str, Any]]]:
        """All pages of a list."""
        pages: list[list[dict[str, Any]]] = []
        while True:
            page = self.get(path, params=query).json()
            pages.append(page["items"])
            if page["cursor"] is None:
                return pages
            query["cursor"] = page["cursor"]

    def pages(self, path: str, **query: Any) -> list[dict[str, Any]]:
        """The items of all pages of a list."""
        return [item for page in self.each_page(path, **query) for item in page]

    def post(self, path: str, body: Any = None, **options: Any) -> httpx.Response:
        return (
            self.request("POST", path, json=body, **options)
            if body is not None
            else self.request("POST", path, **options)
        )

    def put(self, path: str, body: Any) -> httpx.Response:
        return self.request("PUT", path, json=body)

    def delete(self, path: str) -> httpx.Response:
        return self.request("DELETE", path)

    def start(self, device: str, **options: Any) -> httpx.Response:
        """Start an action; default ``request``: ``MOVE``."""
        headers = {"Idempotency-Key": options.pop("idempotency_key")} if "idempotency_key" in options else {}
        return self.post(f"/devices/{device}/actions", {"request": MOVE, **options}, headers=headers)

    def take_lease(self, device: str, **options: Any) -> httpx.Response:
        return self.post(f"/devices/{device}/lease", options)

    def action(self, action: str, **query: Any) -> dict[str, Any]:
        answer = self.get(f"/actions/{action}", params=query)
        assert answer.status_code == 200, answer.text
        action_body: dict[str, Any] = answer.json()
        return action_body


def settings(home: Path, broker: RunningBroker | None = None, **changes: Any) -> Settings:
    """Settings of functions with this home and broker (``None``: no broker).

    Rate limits are off unless a test sets them, because all people of a test share one address.
    """
    unlimited = RateLimits(address=0, account=0, key=0, agent=0)
    without_broker = Settings(**{"home": home, "public_url": BASE, "mqtt_port": 1, "rate_limits": unlimited, **changes})
    if broker is None:
        return without_broker
    return replace(
        without_broker,
        broker=broker.kind,
        mqtt_port=broker.tcp_port,
        websocket_url=f"ws://127.0.0.1:{broker.websocket_port}",
    )


def problem(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    """Assert that a response is this problem in the documented form; returns its body."""
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
    """Yields a person and a paired robot that is online."""
    person = cloud.sign_in(owner)
    with cloud.robot(*names) as robot:
        robot.pair(person)
        robot.connect()
        # With fakes all messages are stored already: waiting would only delay a failure.
        timeout_s = PATIENCE_S if cloud.memory is None else 0
        wait_until(lambda: person.get(f"/devices/{robot.device}").json()["online"], "an online robot", timeout_s)
        yield person, robot
