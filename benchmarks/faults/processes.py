"""The product in processes that can be killed separately, with an agent that reports its decisions."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import httpx

from benchmarks.baseline.product import MqttClient, broker_credentials
from benchmarks.faults.recorder import Recorder
from function_app import settings
from infra.local.supervisor import SupervisedProcess
from tests.faults.stack import Stack
from tests.harness.cloud.cloud import Cloud
from tests.harness.cloud.people import sign_in_link
from tests.harness.network.brokers import BrokerKind, wait_until
from tests.harness.network.delay import start_delay
from tests.harness.network.proxy import Proxy

STREAMING_ARM, ACTION_ARM = "arm0", "arm1"
"""The streaming operator controls one arm, the action load the other."""
_WATCHDOG_S = 0.3


class ProductProcesses(Stack):
    """A ``Stack`` whose agent also connects through a simulated network (``tests.harness.network.delay``).

    Attributes:
        recorder: Recorded control periods of the agent.
        network: Simulated network between the agent and the broker.
        operator_network: The same between the operators and the broker.
        owner: HTTP client with a sign-in session, for requests that an API key may not make.
    """

    AGENT = "benchmarks.faults.agent"

    def __init__(self, kind: BrokerKind) -> None:
        super().__init__(kind, 2, watchdog_s=_WATCHDOG_S)
        self.kind = kind
        self.recorder = Recorder(self.home / "recorder.socket")
        self._closing.callback(self.recorder.close)

    def begin(self) -> None:
        """Starts all processes."""
        super().begin()
        self.owner = self._closing.enter_context(httpx.Client(base_url=self.api, timeout=15))
        link = sign_in_link(self._environment, "ann")
        token = self.owner.post("/auth/sign-in", json={"link": link}).json()["access_token"]
        self.owner.headers["Authorization"] = f"Bearer {token}"
        self.owner.cookies.clear()
        self.cloud = self._closing.enter_context(Cloud(settings.read(self._environment)))

    def _child(self, name: str, module: str, *arguments: str) -> SupervisedProcess:
        return super()._child(name, "benchmarks.faults.launcher", module, *arguments)

    def _proxy(self, behind: int, received: Callable[[bytes], None]) -> Proxy:
        self.network = self._closing.enter_context(start_delay(behind, rtt_ms=0))
        self.operator_network = self._closing.enter_context(start_delay(behind, rtt_ms=0))
        self.operator_port = self.operator_network.ports[behind]
        return super()._proxy(self.network.ports[behind], received)

    def device(self, name: str) -> str:
        """Returns the HTTP path of a device."""
        return f"/devices/{self.agent_id}-{name}"

    def topic(self, name: str) -> str:
        """Returns the topic prefix of a device."""
        return f"ts/v1/{self.space}/{self.agent_id}/{name}"

    @contextlib.contextmanager
    def issued(self, request: dict[str, Any], *topics: str) -> Iterator[MqttClient]:
        """Connects a client with credentials from the API."""
        issued = self.post("/mqtt/credentials", **request)
        login = (issued["client_id"], issued["username"], issued["password"])
        with MqttClient(self.port + 1, *login, subscribe=topics, qos=0) as client:
            yield client

    @contextlib.contextmanager
    def allowed(
        self, name: str, *, publish: tuple[str, ...] = (), subscribe: tuple[str, ...] = ()
    ) -> Iterator[MqttClient]:
        """Connects a client with exactly these permissions, which the API would not issue."""
        with MqttClient(
            self.port + 1, *broker_credentials(self.cloud, name, publish, subscribe), subscribe=subscribe, qos=1
        ) as client:
            yield client

    def restart_agent_without_proxies(self) -> None:
        """Restarts the agent with a direct connection to the broker."""
        self.agent.stop()
        self.agent = self._child("agent", self.AGENT, *self.agent_arguments(self.port + 1))
        self.agent.wait_for_line("running", 60)
        own = [self.device(name) for name in self.names]
        wait_until(lambda: all(self.http.get(each).json()["online"] for each in own), "the devices to be online")


@contextlib.contextmanager
def start(kind: BrokerKind) -> Iterator[ProductProcesses]:
    """Runs the product with two arms."""
    product = ProductProcesses(kind)
    try:
        product.begin()
        yield product
    finally:
        product.close()
