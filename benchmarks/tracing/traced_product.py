"""The product with one simulated robot and tracing, with a simulated network for the operator and the agent."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from benchmarks.baseline.product import HttpConnection, MeasuredProduct
from benchmarks.tracing import traced_programs
from benchmarks.tracing.timestamps import TimestampReceiver
from function_app import settings
from tests.harness.browser.product import PORTS, Machine, start_program
from tests.harness.cloud.cloud import Cloud
from tests.harness.network.brokers import BrokerKind
from tests.harness.network.delay import DelayedNetwork, start_delay
from tests.harness.network.ports import free_port


class TracedProduct(MeasuredProduct):
    """A ``MeasuredProduct`` with tracing; ``start`` creates it.

    Attributes:
        timestamps: Receives the timestamps of its programs.
    """

    def __init__(
        self,
        machine: Machine,
        kind: BrokerKind,
        cloud: Cloud,
        *,
        timestamps: TimestampReceiver,
        network: DelayedNetwork,
    ) -> None:
        super().__init__(machine, kind, cloud)
        self.timestamps = timestamps
        self._network = network
        self._delayed = False

    def set_delay(self, *, rtt_ms: float) -> None:
        """Sets the network delay of operator and agent; it applies to new connections of the operator."""
        self._network.set(rtt_ms=rtt_ms)
        self._delayed = rtt_ms > 0

    @property
    def mqtt_port(self) -> int:
        """Port at which the operator reaches the broker."""
        return self._network.ports[super().mqtt_port] if self._delayed else super().mqtt_port

    def caller(self) -> HttpConnection:
        """Returns an open connection of the operator to the API."""
        port = self._network.ports[self.machine.port] if self._delayed else self.machine.port
        return HttpConnection(port, {"Authorization": f"Bearer {self.token}"})


@contextlib.contextmanager
def start(home: Path, kind: BrokerKind, joints: Mapping[str, str], **more: str) -> Iterator[TracedProduct]:
    """Runs the product with one robot in its own scene, or a whole room if ``more`` has ``TELESCOPE_ROOM``.

    The agent reaches server and broker through a delay proxy, which adds no delay before ``set_delay`` is called.

    Args:
        home: Folder of the product.
        kind: Broker.
        joints: Robot → joints with traced motion, separated by ``+``.
        more: Further settings.
    """
    port = free_port(PORTS)
    with contextlib.ExitStack() as stack:
        timestamps = stack.enter_context(TimestampReceiver())
        network = stack.enter_context(start_delay(port, port + 1, rtt_ms=0))
        variables = {
            "TELESCOPE_BROKER": kind,
            "TELESCOPE_RATE_KEY": "0",
            "TELESCOPE_RATE_ACCOUNT": "0",
            traced_programs.DEVICE: next(iter(joints)),
            traced_programs.JOINTS: ",".join(f"{robot}:{each}" for robot, each in joints.items()),
            traced_programs.PORTS: ",".join(f"{each}={network.ports[each]}" for each in network.ports),
            **timestamps.settings,
            **more,
        }
        machine = stack.enter_context(
            start_program("benchmarks.tracing.traced_programs machine", home, port, variables)
        )
        if machine.process.poll() is not None:
            raise RuntimeError("".join(machine.lines))
        environment = {"TELESCOPE_HOME": str(home), "TELESCOPE_PORT": str(machine.port), **variables}
        cloud = stack.enter_context(Cloud(settings.read(environment)))
        yield TracedProduct(machine, kind, cloud, timestamps=timestamps, network=network)
