"""A real Prosody, an XMPP gateway, and a fake robot that uses XMPP.

with open_site(...) as site:                        # functions, HTTP, Prosody and one gateway
    with site.robot() as robot:
        robot.pair(anna)
        robot.connect()
"""

import asyncio
import contextlib
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import uvicorn

from device_agent.protocol.xmpp.stream import Login, Stream
from device_agent.transports.xmpp import XmppAccess, XmppTransport
from function_app.entrypoints.xmpp.program import create_gateway
from function_app.ports.broker_access import Credentials
from function_app.settings import Settings, Xmpp
from infra.prosody.configuration import PATH
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.cloud.cloud_processes import CloudProcesses, start_cloud_processes
from tests.harness.hosts.host import environment_of, start_program
from tests.harness.network.brokers import HOST, PATIENCE_S, Client, Message, RunningBroker, wait_until
from tests.harness.network.ports import free_port
from tests.harness.paths import ROOT

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from function_app.entrypoints.xmpp.gateway import XmppGateway

DOMAIN = "telescope.localhost"


@dataclass
class Prosody:
    """A Prosody process. ``websocket_port``: for browsers."""

    process: "subprocess.Popen[str]"
    home: Path
    port: int
    websocket_port: int

    def kill(self) -> None:
        """Kill Prosody and the program that runs it."""
        self.process.kill()
        self.process.wait(PATIENCE_S)
        wait_until(self._gone, "the end of Prosody")

    def _gone(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex((HOST, self.port)) != 0

    def stderr(self) -> str:
        return (self.home / "stderr").read_text()


@contextlib.contextmanager
def start_prosody(home: Path, verify_url: str, *, port: int = 0, more: tuple[str, ...] = ()) -> Iterator[Prosody]:
    home.mkdir(parents=True, exist_ok=True)
    where = ("--home", str(home), "--port", str(port or free_port()), "--websocket-port", str(free_port()))
    named = ("--domain", DOMAIN, "--verify-url", verify_url, *more)
    with (home / "stderr").open("a") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "infra.prosody", *where, *named],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        )
        with process:
            try:
                assert process.stdout is not None
                line = process.stdout.readline()
                assert line.startswith("ready xmpp="), f"{line!r} {(home / 'stderr').read_text()}"
                ports = [int(each.partition("=")[2]) for each in line.split()[1:]]
                yield Prosody(process, home, *ports)
            finally:
                if process.poll() is None:
                    process.terminate()
                    process.wait(PATIENCE_S)


class ProsodyEndpoint:
    """Prosody as an endpoint of a transport."""

    def __init__(self, home: Path, verify_url: str, port: int, stack: contextlib.ExitStack) -> None:
        self.port = port
        self._begin = lambda: stack.enter_context(start_prosody(home, verify_url, port=port))
        self._now = self._begin()

    def kill(self) -> None:
        self._now.kill()

    def revive(self) -> None:
        self._now = self._begin()


@contextlib.contextmanager
def served(cloud: Cloud, listener: socket.socket) -> Iterator[None]:
    """Serve the functions' HTTP API on a listening socket."""
    server = uvicorn.Server(uvicorn.Config(cloud.app, log_level="warning", lifespan="off"))
    running = asyncio.run_coroutine_threadsafe(server.serve(sockets=[listener]), cloud.loop)
    try:
        yield
    finally:
        server.should_exit = True
        running.result(PATIENCE_S)


class Gateway:
    """An XMPP gateway in the functions' event loop."""

    def __init__(self, cloud: Cloud) -> None:
        self.cloud = cloud

        async def start() -> "tuple[XmppGateway, asyncio.Task[None]]":
            gateway = create_gateway(cloud.functions, cloud.app)
            return gateway, asyncio.create_task(gateway.run())

        self.gateway, self._task = cloud.run(start())

    def serves(self, agent: str) -> bool:
        return agent in self.gateway._sessions

    def end(self) -> None:
        async def stop() -> None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

        self.cloud.run(stop())


@dataclass
class XmppSite:
    """Functions, an XMPP server, and gateways."""

    cloud: Cloud
    prosody: Prosody
    url: str
    gateways: list[Gateway] = field(default_factory=list)

    def start_gateway(self) -> Gateway:
        self.gateways.append(Gateway(self.cloud))
        return self.gateways[-1]

    def robot(self, *names: str) -> "XmppRobot":
        return XmppRobot(self.cloud, names or ("arm",))

    def client(self, user: str, password: str, **options: Any) -> "XmppClient":
        return XmppClient(self.prosody.port, user, password, **options)

    def watcher(self, broker: RunningBroker) -> Client:
        """A broker connection with the functions' rights."""
        service = self.cloud.functions.access.service_credentials()
        client = broker.connect(service.client_id, Credentials(service.username, service.password))
        assert client.connected.is_set(), client.answer
        return client

    def person(self, person: Person) -> "XmppClient":
        """An XMPP client of a person."""
        issued = person.post("/xmpp/credentials", {"purpose": "view"}).json()
        return self.client(person.account, issued["password"])


@contextlib.contextmanager
def open_site(
    open_cloud: Callable[[Settings], Cloud], settings: Settings, folder: Path, *, gateway: bool = True
) -> Iterator[XmppSite]:
    """Start the site.

    Args:
        open_cloud: Creates the functions.
        settings: Their settings, without XMPP.
        folder: For Prosody's files.
        gateway: Whether to start a gateway.
    """
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.create_server((HOST, 0)))
        url = f"http://{HOST}:{listener.getsockname()[1]}"
        prosody = stack.enter_context(start_prosody(folder, f"{url}/api/v1/xmpp/verify"))
        websocket_url = f"ws://{HOST}:{prosody.websocket_port}{PATH}"
        xmpp = Xmpp(domain=DOMAIN, host=HOST, port=prosody.port, websocket_url=websocket_url)
        cloud = open_cloud(replace(settings, xmpp=xmpp))
        stack.enter_context(served(cloud, listener))
        site = XmppSite(cloud, prosody, url)
        if gateway:
            site.start_gateway()
        try:
            yield site
        finally:
            for each in site.gateways:
                each.end()


class XmppRobot(Robot):
    """``Robot`` over XMPP, with the agent's own transport.

    Attributes:
        setpoints: Received setpoints.
        changes: Link states reported by the transport.
        listen: Additional topics to subscribe to.
        space_messages: Messages received on those.
    """

    def __init__(self, place: Any, names: tuple[str, ...]) -> None:
        super().__init__(place, names)
        self.setpoints: list[tuple[str, bytes]] = []
        self.changes: list[bool] = []
        self.login_errors: list[str] = []
        self.listen: tuple[str, ...] = ()
        self.space_messages: list[tuple[str, bytes]] = []

    def introduction(self, **changes: Any) -> dict[str, Any]:
        return super().introduction(**{"transport": "xmpp", **changes})

    def access(self) -> XmppAccess:
        answer = self.request("POST", "/xmpp/credentials", json={"purpose": "agent"})
        if answer.status_code != 200:
            self.login_errors.append(answer.text)
            raise ValueError(answer.text)
        issued = answer.json()
        login = Login(issued["host"], issued["port"], issued["jid"], issued["password"])
        return XmppAccess(login, issued["cloud"], issued["lifetime_s"])

    def next_session(self) -> int:
        self.session += 1
        return self.session

    def connect(self) -> Self:
        """Connect and wait for the link."""
        line: Any = _Line(self)
        self.link = line
        wait_until(lambda: self.changes[-1:] == [True], "the link over XMPP")
        return self

    def handle(self, message: Message) -> None:
        if "/ctl/" in message.topic:
            self.setpoints.append((message.topic, message.payload))
        if "/tele/" in message.topic:
            self.space_messages.append((message.topic, message.payload))
        super().handle(message)


class _Line:
    """Replaces the fake robot's MQTT connection."""

    def __init__(self, robot: XmppRobot) -> None:
        self.transport = XmppTransport(
            access=robot.access,
            presence_topic=f"ts/v1/{robot.space}/{robot.id}/conn",
            next_session=robot.next_session,
            software="toy 1",
            listen=robot.listen,
        )
        self.transport.start(
            lambda topic, payload: robot.handle(Message(topic, payload, 1, retain=False)), robot.changes.append
        )

    def publish(self, topic: str, payload: bytes) -> None:
        self.transport.publish(topic, payload, qos=1)

    def publish_acknowledged(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        done = threading.Event()
        assert self.transport.publish(topic, payload, qos=1, retain=retain, delivered=done.set)
        assert done.wait(PATIENCE_S), f"no receipt for {topic}"

    def close(self) -> None:
        self.transport.stop()


class XmppClient:
    """A generic XMPP client; a context manager that disconnects.

    Attributes:
        on_message: Called with each message in the thread of the client; a test may replace it.
    """

    def __init__(self, port: int, user: str, password: str, *, resource: str = "test") -> None:
        self.messages: list[Element] = []
        self.on_message: Callable[[Element], None] = lambda _: None
        self.presences: list[Element] = []
        self.trouble: OSError | None = None
        self._login = Login(HOST, port, f"{user}@{DOMAIN}/{resource}", password)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self.opened = self._run(self._open())

    async def _open(self) -> bool:
        self.stream = Stream(self._login, message=self._receive, presence=self.presences.append)
        try:
            await self.stream.open()
        except OSError as error:
            self.trouble = error
            return False
        self._staying = asyncio.create_task(self.stream.stay())
        return True

    def _receive(self, stanza: "Element") -> None:
        self.messages.append(stanza)
        self.on_message(stanza)

    @property
    def ended(self) -> bool:
        return not self.opened or self._staying.done()

    def send(self, stanza: str) -> None:
        self._loop.call_soon_threadsafe(self.stream.send, stanza)

    def is_available(self, user: str) -> bool:
        """Whether the newest presence of this user is available."""
        presences = [each for each in self.presences if each.get("from", "").startswith(f"{user}@")]
        return bool(presences) and presences[-1].get("type") is None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        async def close() -> None:
            if self.opened:
                self._staying.cancel()
                await asyncio.gather(self._staying, return_exceptions=True)
            await self.stream.close()

        self._run(close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(PATIENCE_S)


@contextlib.contextmanager
def start_xmpp_processes(folder: Path, more: Mapping[str, str] | None = None) -> Iterator[CloudProcesses]:
    """Cloud processes with these additional settings, Prosody and an XMPP gateway."""
    port = free_port()
    settings = {"TELESCOPE_XMPP_DOMAIN": DOMAIN, "TELESCOPE_XMPP_HOST": HOST, "TELESCOPE_XMPP_PORT": str(port)}
    settings |= more or {}
    with start_cloud_processes("mosquitto", folder, settings) as processes:
        end = ProsodyEndpoint(folder / "prosody", f"{processes.url}/api/v1/xmpp/verify", port, processes.stack)
        processes.endpoints["xmpp"] = end
        environment = environment_of(
            {**processes.environment, "TELESCOPE_PORT": str(processes.endpoints["server"].port)}
        )
        processes.stack.enter_context(start_program(["-m", "function_app", "xmpp"], environment))
        yield processes
