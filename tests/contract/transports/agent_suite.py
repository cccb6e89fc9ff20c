"""Contract of a whole agent with the simulated UR5 over each transport: same commands, same journal, same safety.

A test class inherits ``AgentSuite`` and sets ``spoken``, as for ``TransportSuite``.
"""

import contextlib
import itertools
import sqlite3
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from device_agent import bootstrap
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry, HttpPolling, Recording
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.ports.clock import CloudClock
from device_agent.protocol import Ack, AckStatus, MoveJoints, State, codec, topics
from device_agent.transports.http.client import CloudClient
from device_agent.transports.pairing_monitor import SOFTWARE
from tests.contract.transports.suite import Spoken
from tests.harness.cloud.cloud_processes import CloudProcesses
from tests.harness.network.brokers import wait_until

FAR = {"shoulder_pan": 6.0}
"""Almost two seconds away from home at full speed, without obstacles."""
_RESOLUTION_RAD = 1e-9
"""Smaller steps are rounding errors."""
HELD_WITHIN_MS = 350
_STORE_DOWN_S = 3.0
"""Time for which nothing can be stored after the end of an action [s]."""


class PairedAgent:
    """An agent in this process, owned by the account ``anna``.

    Attributes:
        commanded: Time [s] and position [rad] of each command to the driver.
        interrupted_s: Times at which the controller was interrupted.
        links: Changes of the link.
    """

    def __init__(self, processes: CloudProcesses, spoken: Spoken, folder: Path) -> None:
        self.processes = processes
        self.store = IdentityStore(folder)
        key = self.store.private_key(create=True)
        config = AgentConfig(
            server=processes.url,
            name="lab",
            devices=(DeviceEntry(name="arm", type="ur5"),),
            recording=Recording(enabled=False),
            **spoken.configuration,
        )
        config.save(self.store.folder)
        api = CloudClient(processes.url, key, CloudClock())
        claim = api.enroll(
            name="lab", software=SOFTWARE, transport=config.transport, devices=catalogue.enrolled_devices(config)
        )
        self.id: str = processes.anna.post("/agents/claim", {"code": claim.code}).json()["devices"][0]["id"]
        enrollment = api.enrollment()
        self.agent: str = enrollment["agent"]
        keys = {each["id"]: each["public"] for each in enrollment["keys"]}
        self.store.save_pairing(Pairing(agent=self.agent, space=enrollment["space"], account="anna", keys=keys))
        self._page = processes.viewer(self.agent)
        self._acks: list[Ack] = []
        self._states: list[State] = []
        self.start()

    def start(self) -> None:
        self.cell = bootstrap.build(self.store)
        agent: Any = self.cell.agent
        self.device: Any = agent._devices["arm"]
        driver: Any = self.device._driver
        controller: Any = self.device._controller
        self.commanded: list[tuple[float, tuple[float, ...]]] = []
        self.interrupted_s: list[float] = []
        self.links: list[bool] = []
        send, interrupt, change = driver.send, controller.interrupt, agent._link_changed

        def recorded_send(position_rad: Sequence[float], *more: Any) -> Any:
            self.commanded.append((time.monotonic(), tuple(position_rad)))
            return send(position_rad, *more)

        def recorded_interrupt(*reason: Any) -> Any:
            self.interrupted_s.append(time.monotonic())
            return interrupt(*reason)

        def recorded_change(up: bool) -> None:
            change(up)
            self.links.append(up)

        driver.send, controller.interrupt, agent._link_changed = recorded_send, recorded_interrupt, recorded_change
        self.cell.start()
        wait_until(self.online, "the agent to be online")

    def online(self) -> bool:
        online: bool = self.processes.anna.get(f"/devices/{self.id}").json()["online"]
        return online

    def take(self) -> int:
        """Takes control and returns the epoch."""
        answer = self.processes.anna.take_lease(self.id, wait_ms=20_000, lease_ms=600_000)
        assert answer.json()["confirmed"], answer.text
        assert answer.json()["streaming"] == self.device.publisher._description().streaming
        epoch: int = answer.json()["epoch"]
        return epoch

    def move(self, target: dict[str, float], *, speed: float = 1.0, **options: Any) -> dict[str, Any]:
        request = {"kind": "move_joints", "position_rad": target, "speed": speed}
        action: dict[str, Any] = self.processes.anna.start(self.id, request=request, wait_ms=30_000, **options).json()
        assert "id" in action, action
        return action

    def end_of(self, action: str) -> dict[str, Any]:
        return self.processes.anna.action(action, wait_ms=30_000, wait_for="done")

    def acks(self, command: str) -> list[AckStatus]:
        """Acknowledgements of a command at the broker, including repeated ones."""
        self._receive()
        return [ack.status for ack in self._acks if ack.id == command]

    def stopped(self) -> bool:
        """Whether the newest state at the broker shows a latched Stop."""
        self._receive()
        return bool(self._states) and self._states[-1].stop is not None

    def _receive(self) -> None:
        for message in self._page.pending():
            kind = topics.parse(message.topic).kind
            if kind == topics.ACK:
                self._acks.append(codec.decode(message.payload, Ack))
            elif kind == topics.STATE:
                self._states.append(codec.decode(message.payload, State))

    def journalled(self, command: str) -> Ack:
        """The last acknowledgement in the agent's journal."""
        rows = self.cell._journal._execute("SELECT last_ack FROM commands")
        (last,) = [ack for (payload,) in rows if (ack := codec.decode(payload, Ack)).id == command]
        return last

    def moved_since(self, start_s: float) -> list[float]:
        """Times after ``start_s`` at which the commanded position changed [s]."""
        steps = itertools.pairwise([each for each in list(self.commanded) if each[0] > start_s])
        return [
            at_s - start_s
            for (_, before), (at_s, after) in steps
            if any(abs(one - other) > _RESOLUTION_RAD for one, other in zip(before, after, strict=True))
        ]

    def stop(self) -> None:
        self.cell.stop()
        self._page.close()


class AgentSuite:
    """Contract of an agent over a transport."""

    spoken: Spoken

    @pytest.fixture
    def agent(self, processes: CloudProcesses, spoken: Spoken, tmp_path: Path) -> Iterator[PairedAgent]:
        agent = PairedAgent(processes, spoken, tmp_path / "agent")
        yield agent
        agent.stop()

    def test_the_same_commands_leave_the_same_journal(self, processes: CloudProcesses, agent: PairedAgent) -> None:
        epoch = agent.take()
        done = agent.move({"shoulder_pan": 0.3}, epoch=epoch, wait_for="done")
        assert done["status"] == "done", done
        epoch = self._a_repeated_command_runs_once(processes, agent, epoch)
        cancelled = agent.move(FAR, speed=0.3, epoch=epoch, wait_for="started")
        assert processes.anna.post(f"/actions/{cancelled['id']}/cancel").status_code < 300
        ended = agent.end_of(cancelled["id"])
        assert ended["status"] == "cancelled", ended
        stopped = agent.move(FAR, speed=0.3, epoch=epoch, wait_for="started")
        wait_until(lambda: processes.anna.post(f"/devices/{agent.id}/stop").json()["confirmed"], "the Stop")
        assert agent.end_of(stopped["id"])["reason"]["code"] == "stopped"
        self._a_restart_keeps_the_latch_and_the_epoch(processes, agent, epoch)

    @staticmethod
    def _a_repeated_command_runs_once(processes: CloudProcesses, agent: PairedAgent, epoch: int) -> int:
        move = MoveJoints(position_rad={"shoulder_pan": 0.6}, speed=1.0)
        order = processes.command(agent.agent, move, epoch=epoch)
        processes.deliver(agent.agent, order)
        wait_until(lambda: AckStatus.DONE in agent.acks(order.command), "its end")
        acks, ticks = agent.acks(order.command), len(agent.commanded)
        processes.deliver(agent.agent, order)
        new_epoch = agent.take()  # the agent now requests other commands
        wait_until(lambda: len(agent.acks(order.command)) > len(acks), "the last acknowledgement again")
        statuses = list(dict.fromkeys(agent.acks(order.command)))
        assert statuses[-3:] == [AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE]
        assert len({position for _, position in agent.commanded[ticks:]}) <= 1, "the robot moved again"
        return new_epoch

    @staticmethod
    def _a_restart_keeps_the_latch_and_the_epoch(processes: CloudProcesses, agent: PairedAgent, epoch: int) -> None:
        agent.cell.stop()
        wait_until(lambda: not agent.online(), "the agent to be offline")
        agent.start()
        wait_until(agent.stopped, "the latch")
        assert agent.move(FAR, epoch=epoch, wait_for="done")["reason"]["code"] == "lease_ended"
        new_epoch = agent.take()
        assert new_epoch > epoch
        assert agent.move(FAR, epoch=new_epoch, wait_for="done")["reason"]["code"] == "stopped"
        wait_until(lambda: processes.anna.post(f"/devices/{agent.id}/stop/reset").json()["confirmed"], "the reset")
        assert agent.move({"shoulder_pan": 0.0}, epoch=agent.take(), wait_for="done")["status"] == "done"

    def test_the_cloud_receives_latencies(self, processes: CloudProcesses, agent: PairedAgent, spoken: Spoken) -> None:
        agent.take()

        def latencies() -> list[dict[str, Any]]:
            answer = processes.anna.get(f"/devices/{agent.id}/latency", params={"path": "device-cloud"})
            items: list[dict[str, Any]] = answer.json()["items"]
            return items

        wait_until(latencies, "the agent's samples")
        (item,) = latencies()
        plain = "-poll" if spoken.configuration.get("http", HttpPolling()).poll == "plain" else ""
        assert item["transport"] == spoken.configuration.get("transport", "mqtt") + plain
        assert item["count"] >= 1
        assert item["min_ms"] > 0

    def test_an_action_that_ends_while_nothing_can_be_stored_has_the_same_end(
        self, processes: CloudProcesses, agent: PairedAgent
    ) -> None:
        action = agent.move(FAR, speed=0.8, epoch=agent.take(), wait_for="started")["id"]
        with contextlib.closing(sqlite3.connect(processes.home / "tables.sqlite", isolation_level=None)) as store:
            store.execute("BEGIN IMMEDIATE")
            wait_until(lambda: agent.journalled(action).status.terminal, "the end at the device")
            ended = agent.journalled(action)
            time.sleep(_STORE_DOWN_S)
            store.execute("ROLLBACK")
        shown = agent.end_of(action)
        reason = ended.reason and {"code": ended.reason.code, "message": ended.reason.message}
        assert (shown["status"], shown["reason"]) == (ended.status.value, reason)

    def test_a_lost_link_ends_motion_and_nothing_resumes(
        self, processes: CloudProcesses, agent: PairedAgent, spoken: Spoken
    ) -> None:
        epoch = agent.take()
        action = agent.move(FAR, speed=0.3, epoch=epoch, wait_for="started")
        wait_until(lambda: agent.commanded[-1][1][0] > 0.3, "motion at full speed")
        before = len(agent.interrupted_s)
        processes.endpoints[spoken.endpoint].kill()
        wait_until(lambda: len(agent.interrupted_s) > before, "the loss", 4 * spoken.notices_s)
        wait_until(lambda: not agent.device._controller.moving, "rest")
        moving = agent.moved_since(agent.interrupted_s[before])
        assert len(moving) * catalogue.TYPES.load("ur5").period_ms <= HELD_WITHIN_MS, moving
        processes.endpoints[spoken.endpoint].revive()
        back_s = time.monotonic()
        wait_until(lambda: agent.links == [True, False, True], "the agent to be back")
        last = agent.journalled(action["id"])
        assert last.reason is not None
        assert (last.status, last.reason.code) == (AckStatus.FAILED, "link_lost")
        assert agent.end_of(action["id"])["reason"]["code"] == "link_lost"
        time.sleep(0.5)
        assert agent.moved_since(back_s) == [], "nothing resumes"
        assert agent.take() > epoch
