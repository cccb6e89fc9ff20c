"""All checks of one simulation, and what they need to know about it."""

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from device_agent.protocol import topics
from tests.simulation.checks.history import Operation
from tests.simulation.checks.leases import FREE, LEASE_CALLS, LeaseObject, reverted_reads
from tests.simulation.checks.linearizability import is_linearizable
from tests.simulation.checks.robots import RobotChecks
from tests.simulation.checks.rows import RowChecks
from tests.simulation.engine.scheduler import EPOCH_MS

if TYPE_CHECKING:
    from tests.simulation.actors.agent import AgentMachine
    from tests.simulation.network.broker import Link, Packet
    from tests.simulation.world import World

_CLOCK_MS = 100
"""Tolerance of a time to live, besides the error of the agent's estimate of the cloud's clock [ms]."""


class Monitors:
    """See the module."""

    def __init__(self, world: "World") -> None:
        self._world = world
        self.rows = RowChecks(world.history, now_s=world.loop.time)
        self.robots = RobotChecks(world.history, now_s=world.loop.time, slow_s=self._slow_s, late_ms=self._late_ms)

    def agent_built(self, machine: "AgentMachine", devices: Mapping[str, Any]) -> None:
        """A process of an agent has created its devices."""
        for name, device in devices.items():
            self.robots.built(machine.device_id(name), device, machine.positions_rad[name])

    def agent_killed(self, machine: "AgentMachine") -> None:
        """The process of an agent has ended."""
        for name in machine.device_names:
            self.robots.killed(machine.device_id(name))

    def stop_confirmed(self, operation: Operation) -> None:
        """A caller received the confirmation of a Stop."""
        self.robots.stop_confirmed(operation.device, operation.invoked_s)

    def routed(self, link: "Link", packet: "Packet") -> None:
        """The broker delivers a message: only the owner and people with a share may receive it."""
        if link.machine not in self._world.people:
            return
        owner = self._world.owner_of(f"{topics.parse(packet.topic).agent}-")
        if link.machine != owner.name and not (link.machine == "carl" and owner.name == "anna"):
            self._world.history.violate("tenant", f"{link.machine} received {packet.topic}")

    def check_operations(self) -> None:
        """Check that the responses of the API are those of one lease and one state of each action."""
        history, faults = self._world.history, self._world.faults
        if faults.restored:
            return  # responses before the restore are not valid after it
        for text in reverted_reads(history.operations):
            history.violate("reverted-read", text)
        for device in self._world.devices:
            lease = LeaseObject(
                device_ended_s=partial(self.robots.ended_s, device),
                expires_s=lambda expires_ms: (expires_ms - EPOCH_MS) / 1000,
                clocks_jumped=faults.clock_jumped,
            )
            calls = [each for each in history.operations if each.device == device and each.kind in LEASE_CALLS]
            if not is_linearizable(calls, FREE, lease.step):
                history.violate("lease-not-linearizable", f"{device}: no order of the calls explains the responses")

    def _slow_s(self, device: str) -> float:
        driver = self._world.machine_of(device).drivers.get(device.partition("-")[2])
        return 0.0 if driver is None else 2 * driver.slow_s

    def _late_ms(self, device: str, action: str, ttl_ms: int) -> float:
        """How long after its time to live an action starts now [ms]."""
        fact = self.rows.actions.get(action)
        if fact is None:
            return 0.0
        age_ms = (self._world.loop.time() - fact.issued_s) * 1000
        return age_ms - ttl_ms - self._world.machine_of(device).clock_error_ms - _CLOCK_MS
