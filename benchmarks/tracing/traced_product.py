"""The product with one simulated robot and tracing, with simulated networks before the operator and the agent."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from benchmarks.baseline.product import HttpConnection, MeasuredProduct
from benchmarks.tracing import traced_programs
from benchmarks.tracing.timestamps import TimestampReceiver
from function_app import settings
from tests.harness.browser.product import Machine, free_ports, start_program
from tests.harness.cloud.cloud import Cloud
from tests.harness.network.brokers import BrokerKind
from tests.harness.network.delay import DelayedNetwork, start_delay


class TracedProduct(MeasuredProduct):
    """A ``MeasuredProduct`` with tracing; ``start`` creates it.

    Attributes:
        marks: Receives the timestamps of its programs.
    """

    def __init__(
        self, machine: Machine, kind: BrokerKind, cloud: Cloud, *, marks: TimestampReceiver, way: DelayedNetwork
    ) -> None:
        super().__init__(machine, kind, cloud)
        self.marks = marks
        self._way = way
        self._far = False

    def place(self, *, rtt_ms: float) -> None:
        """Sets the network delay of operator and agent; it applies to connections of the operator from now on."""
        self._way.set(rtt_ms=rtt_ms)
        self._far = rtt_ms > 0

    @property
    def mqtt_port(self) -> int:
        """Port at which the operator reaches the broker."""
        return self._way.ports[super().mqtt_port] if self._far else super().mqtt_port

    def caller(self) -> HttpConnection:
        """Returns an open connection of the operator to the API."""
        port = self._way.ports[self.machine.port] if self._far else self.machine.port
        return HttpConnection(port, {"Authorization": f"Bearer {self.token}"})


@contextlib.contextmanager
def start(home: Path, kind: BrokerKind, joints: Mapping[str, str], **more: str) -> Iterator[TracedProduct]:
    """Runs the product with one robot in its own scene, or a whole room if ``more`` has ``TELESCOPE_ROOM``.

    The agent reaches server and broker through a delay proxy, which adds no delay before ``place`` is called.

    Args:
        home: Folder of the product.
        kind: Broker.
        joints: Robot → joints with traced motion, separated by ``+``.
        more: Further settings.
    """
    port = free_ports()
    with contextlib.ExitStack() as stack:
        marks = stack.enter_context(TimestampReceiver())
        way = stack.enter_context(start_delay(port, port + 1, rtt_ms=0))
        wanted = {
            "TELESCOPE_BROKER": kind,
            "TELESCOPE_RATE_KEY": "0",
            "TELESCOPE_RATE_ACCOUNT": "0",
            traced_programs.DEVICE: next(iter(joints)),
            traced_programs.JOINTS: ",".join(f"{robot}:{each}" for robot, each in joints.items()),
            traced_programs.WAYS: ",".join(f"{each}={way.ports[each]}" for each in way.ports),
            **marks.settings,
            **more,
        }
        machine = stack.enter_context(start_program("benchmarks.tracing.traced_programs machine", home, port, wanted))
        if machine.process.poll() is not None:
            raise RuntimeError("".join(machine.lines))
        given = {"TELESCOPE_HOME": str(home), "TELESCOPE_PORT": str(machine.port), **wanted}
        cloud = stack.enter_context(Cloud(settings.read(given)))
        yield TracedProduct(machine, kind, cloud, marks=marks, way=way)
