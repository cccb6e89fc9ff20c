"""From an operator through the product to a robot and back: setpoints one way, telemetry the other.

The operator is an XMPP client (slixmpp) with a lease, as ``examples/xmpp_operator.py``. The robot answers each setpoint
with one telemetry message. One clock measures both ways, because operator and robot run in this process; broker, XMPP
server, gateway and functions run in their own processes.
"""

import contextlib
import itertools
import queue
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

import httpx

from benchmarks.baseline.product import TIMEOUT_S
from benchmarks.papers.exchanges import JOINTS
from device_agent.protocol import JointTarget, Setpoint, codec, topics
from device_agent.protocol.security import setpoints
from device_agent.protocol.xmpp import stanzas
from device_agent.protocol.xmpp.stream import Login
from device_agent.transports.xmpp import XmppAccess
from function_app.ports.broker_access import Credentials
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import API, Person
from tests.harness.cloud.cloud_processes import CloudProcesses
from tests.harness.cloud.polling import Site
from tests.harness.network.brokers import HOST, Client, Message, wait_until
from tests.harness.network.xmpp import XmppRobot
from tests.harness.network.xmpp_operator import XmppOperator

LEASE_MS: Final = 600_000
TELEMETRY: Final = codec.encode({"position_rad": [0.1] * len(JOINTS), "frames": [[0.1] * 7] * (len(JOINTS) + 1)})
Ports = Mapping[int, int]
"""Maps a server's port to the port for clients: the same one or that of a delay proxy."""


class _Answering:
    """Records the arrival of each setpoint and answers with telemetry."""

    def __init__(self) -> None:
        self.arrived: queue.SimpleQueue[float] = queue.SimpleQueue()

    def setpoint(self, robot: Robot) -> None:
        self.arrived.put(time.perf_counter())
        link: Any = robot.link
        topic = f"{robot.topic(topics.TELE)}/joints"
        if isinstance(link, Client):
            link.publish(topic, TELEMETRY, qos=0)
        else:
            link.transport.publish(topic, TELEMETRY, qos=0)


class _MqttRobot(Robot):
    """A robot over MQTT behind the network."""

    def __init__(self, cloud: Any, port: int) -> None:
        super().__init__(cloud, ("arm",))
        self.answering = _Answering()
        self.cloud = _Through(cloud, port)  # type: ignore[assignment]

    def handle(self, message: Message) -> None:
        if f"/{topics.CTL}/" in message.topic:
            self.answering.setpoint(self)
        else:
            super().handle(message)


class _Through:
    """The functions, with the broker behind the network."""

    def __init__(self, cloud: Any, port: int) -> None:
        self._cloud = cloud
        self._port = port

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cloud, name)

    def connect(self, issued: dict[str, Any], **options: Any) -> Client:
        client: Client = self._cloud.connect({**issued, "tcp": {**issued["tcp"], "port": self._port}}, **options)
        return client


class _XmppRobot(XmppRobot):
    """A robot over XMPP behind the network."""

    def __init__(self, site: Site, port: int) -> None:
        super().__init__(site, ("arm",))
        self.answering = _Answering()
        self._port = port

    def access(self) -> XmppAccess:
        issued = super().access()
        login = issued.login
        return replace(issued, login=Login(login.host, self._port, login.jid, login.password))

    def handle(self, message: Message) -> None:
        if f"/{topics.CTL}/" in message.topic:
            self.answering.setpoint(self)
        else:
            super().handle(message)


class _Account:
    """An account at the server that knows Prosody."""

    def __init__(self, site: Site, person: Person) -> None:
        self._site = site
        self.account = person.account
        self.token = person.token

    def post(self, path: str, body: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.token}"}
        return self._site.request("POST", API + path, json=body, headers=headers)


class Path:
    """The way of an operator with a lease to one robot and back.

    Args:
        robot: The robot, which is online.
        publish: Sends a payload to a topic.
        answers: Telemetry that the operator has received.
        lease: The operator's lease.
    """

    def __init__(
        self,
        robot: _MqttRobot | _XmppRobot,
        publish: Callable[[str, bytes], object],
        answers: "queue.SimpleQueue[bytes]",
        lease: dict[str, Any],
    ) -> None:
        self._robot = robot
        self._publish = publish
        self._answers = answers
        self._epoch = lease["epoch"]
        self._key = bytes.fromhex(lease["setpoint_key"])
        self._topic = f"{robot.topic(topics.CTL)}/{self._epoch}"
        self._sequences = itertools.count(1)
        self.to_robot_ms: list[float] = []

    def exchange(self) -> float:
        """Sends one setpoint; returns the time until its telemetry is back [ms]."""
        target = JointTarget(position_rad=dict.fromkeys(JOINTS, 0.1))
        setpoint = Setpoint(
            epoch=self._epoch, sequence=next(self._sequences), echo_tick_ms=1, sent_ms=1.0, target=target
        )
        payload = setpoints.seal(codec.encode(setpoint), self._key, self._topic)
        started_s = time.perf_counter()
        self._publish(self._topic, payload)
        arrived_s = self._robot.answering.arrived.get(timeout=TIMEOUT_S)
        self._answers.get(timeout=TIMEOUT_S)
        self.to_robot_ms.append((arrived_s - started_s) * 1000)
        return (time.perf_counter() - started_s) * 1000


def over_xmpp(stack: contextlib.ExitStack, ports: Ports, processes: CloudProcesses, *, robot_over_xmpp: bool) -> Path:
    """An operator over XMPP; the robot uses XMPP or MQTT."""
    xmpp = ports[processes.endpoints["xmpp"].port]
    broker = ports[processes.broker.port]
    site = Site(processes.url)
    stack.callback(site.close)
    robot = _XmppRobot(site, xmpp) if robot_over_xmpp else _MqttRobot(processes.cloud, broker)
    lease = _online(stack, robot, processes)
    operator = stack.enter_context(XmppOperator(xmpp, _Account(site, processes.anna), resource=robot.id))
    if operator.sign_in().status != 204:  # noqa: PLR2004 (signed in)
        raise RuntimeError("the gateway rejects the operator")
    answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    topic = f"{robot.topic(topics.TELE)}/joints"

    def receive(stanza: Any) -> None:
        delivery = stanzas.parse(stanza)
        if delivery is not None and delivery.topic == topic:
            answers.put(delivery.payload)

    operator.on_message = receive
    operator.listen(topic)
    return Path(robot, operator.publish, answers, lease)


def over_mqtt(stack: contextlib.ExitStack, ports: Ports, processes: CloudProcesses) -> Path:
    """An operator over MQTT to a robot over MQTT, for comparison."""
    port = ports[processes.broker.port]
    robot = _MqttRobot(processes.cloud, port)
    lease = _online(stack, robot, processes)
    answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def client(**purpose: Any) -> Client:
        issued = processes.anna.post("/mqtt/credentials", purpose).json()
        credentials = Credentials(issued["username"], issued["password"])
        return stack.enter_context(Client(issued["client_id"], credentials, port=port).open())

    view, control = client(purpose="view"), client(purpose="control", device=robot.device, epoch=lease["epoch"])
    view.paho.on_message = lambda _c, _u, message: answers.put(bytes(message.payload))
    view.subscribe(f"{robot.topic(topics.TELE)}/joints", qos=0)
    return Path(robot, lambda topic, payload: control.publish(topic, payload, qos=0), answers, lease)


def _online(stack: contextlib.ExitStack, robot: _MqttRobot | _XmppRobot, processes: CloudProcesses) -> dict[str, Any]:
    """Pairs and connects the robot; returns a lease on it."""
    robot.pair(processes.anna)
    stack.enter_context(robot)
    robot.connect()
    wait_until(lambda: processes.anna.get(f"/devices/{robot.device}").json()["online"], f"{robot.id} at {HOST}")
    lease: dict[str, Any] = processes.anna.take_lease(robot.device, lease_ms=LEASE_MS, wait_ms=10_000).json()
    return lease
