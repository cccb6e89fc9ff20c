"""A whole agent with the simulated UR5 over each transport: the same orders, the same journal, the same safety.

A transport's test inherits the class and says what is ``spoken``, as for ``TransportSuite``.
"""

import itertools
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from device_agent import bootstrap
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry, HttpPolling
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.ports.clock import CloudClock
from device_agent.protocol import Ack, AckStatus, MoveJoints, State, codec, topics
from device_agent.transports.http.client import CloudClient
from device_agent.transports.pairing_monitor import SOFTWARE
from tests.contract.transports.suite import Spoken
from tests.harness.cloud.cloud_processes import Ground
from tests.harness.network.brokers import wait_until

FAR = {"shoulder_pan": 6.0}
"""From home almost two seconds away, at any speed, and nothing is in the way."""
_STILL_RAD = 1e-9
"""Steps below this are what adding floating-point numbers leaves."""
HELD_WITHIN_MS = 350


class Resident:
    """An agent of Anna's in this process, and what its arm was told to do, tick by tick."""

    def __init__(self, ground: Ground, spoken: Spoken, folder: Path) -> None:
        self.ground = ground
        self.store = IdentityStore(folder)
        key = self.store.private_key(create=True)
        told = AgentConfig(
            server=ground.url, name="lab", devices=(DeviceEntry(name="arm", type="ur5"),), **spoken.configuration
        )
        told.save(self.store.folder)
        api = CloudClient(ground.url, key, CloudClock())
        claim = api.enroll(
            name="lab", software=SOFTWARE, transport=told.transport, devices=catalogue.enrolled_devices(told)
        )
        claimed = ground.anna.post("/agents/claim", {"code": claim.code}).json()
        found = api.enrollment()
        self.store.save_pairing(
            Pairing(
                agent=found["agent"],
                space=found["space"],
                account="anna",
                keys={each["id"]: each["public"] for each in found["keys"]},
            )
        )
        self.agent: str = found["agent"]
        self.space: str = found["space"]
        self.id: str = claimed["devices"][0]["id"]
        self.ear = ground.ear(self.agent)
        self._acks: list[Ack] = []
        self._states: list[State] = []
        self.start()

    def start(self) -> None:
        self.cell = bootstrap.build(self.store)
        self.device: Any = self.cell._agent._devices["arm"]
        self.sent: list[tuple[float, tuple[float, ...]]] = []
        self.lost_s: list[float] = []
        driver: Any = self.device._driver
        controller: Any = self.device._controller
        send, lost = driver.send, controller.interrupt

        def noting_send(position_rad: Sequence[float], *more: Any) -> Any:
            self.sent.append((time.monotonic(), tuple(position_rad)))
            return send(position_rad, *more)

        def noting_lost(*why: Any) -> Any:
            self.lost_s.append(time.monotonic())
            return lost(*why)

        agent: Any = self.cell._agent
        changed = agent._link_changed
        self.links: list[bool] = []

        def noting_change(up: bool) -> None:
            changed(up)
            self.links.append(up)

        driver.send, controller.interrupt, agent._link_changed = noting_send, noting_lost, noting_change
        self.cell.start()
        self.online()

    def online(self) -> None:
        wait_until(lambda: self.get()["online"], "the agent to be online")

    def get(self) -> dict[str, Any]:
        found: dict[str, Any] = self.ground.anna.get(f"/devices/{self.id}").json()
        return found

    def take(self) -> int:
        """Take control; the epoch."""
        answer = self.ground.anna.take(self.id, wait_ms=20_000, lease_ms=600_000)
        assert answer.json()["confirmed"], answer.text
        epoch: int = answer.json()["epoch"]
        return epoch

    def move(self, target: dict[str, float], *, speed: float = 1.0, **options: Any) -> dict[str, Any]:
        request = {"kind": "move_joints", "position_rad": target, "speed": speed}
        answer = self.ground.anna.start(self.id, request=request, wait_ms=30_000, **options)
        found: dict[str, Any] = answer.json()
        assert "id" in found, found
        return found

    def end_of(self, action: str) -> dict[str, Any]:
        return self.ground.anna.action(action, wait_ms=30_000, wait_for="done")

    def acks(self, command: str) -> list[AckStatus]:
        """What the page has heard of a command, in order and each once."""
        self._hear()
        return list(dict.fromkeys(ack.status for ack in self._acks if ack.id == command))

    def heard(self, command: str) -> int:
        """How many answers to a command have been heard, repeated ones too."""
        self._hear()
        return sum(ack.id == command for ack in self._acks)

    def state(self) -> State | None:
        """The newest that the page has heard."""
        self._hear()
        return self._states[-1] if self._states else None

    def _hear(self) -> None:
        for message in self.ear.pending():
            kind = topics.parse(message.topic).kind
            if kind == topics.ACK:
                self._acks.append(codec.decode(message.payload, Ack))
            elif kind == topics.STATE:
                self._states.append(codec.decode(message.payload, State))

    def journalled(self) -> list[Ack]:
        """The last answer to each command, as the agent remembers it."""
        rows = self.cell._journal._execute("SELECT last_ack FROM commands")
        return [codec.decode(row[0], Ack) for row in rows]

    def moved_since(self, when_s: float) -> list[float]:
        """Ticks after this moment at which the commanded position was not that of the tick before [s after it]."""
        steps = itertools.pairwise([row for row in list(self.sent) if row[0] > when_s])
        return [
            at_s - when_s
            for (_, before), (at_s, now) in steps
            if any(abs(one - other) > _STILL_RAD for one, other in zip(before, now, strict=True))
        ]

    def at(self) -> float:
        """Where the arm's first joint was last sent to [rad]."""
        return self.sent[-1][1][0]

    def stop(self) -> None:
        self.cell.stop()
        self.ear.close()


class AgentSuite:
    """Inherited by each."""

    spoken: Spoken

    @pytest.fixture
    def resident(self, ground: Ground, spoken: Spoken, tmp_path: Path) -> Iterator[Resident]:
        resident = Resident(ground, spoken, tmp_path / "agent")
        yield resident
        resident.stop()

    def test_the_same_orders_the_same_journal(self, ground: Ground, resident: Resident) -> None:
        epoch = resident.take()
        done = resident.move({"shoulder_pan": 0.3}, epoch=epoch, wait_for="done")
        assert done["status"] == "done", done
        epoch = self._comes_twice_runs_once(ground, resident, epoch)
        cancelled = resident.move(FAR, speed=0.3, epoch=epoch, wait_for="started")
        assert ground.anna.post(f"/actions/{cancelled['id']}/cancel").status_code < 300
        ended = resident.end_of(cancelled["id"])
        assert ended["status"] == "cancelled", ended
        stopped = resident.move(FAR, speed=0.3, epoch=epoch, wait_for="started")
        wait_until(lambda: ground.anna.post(f"/devices/{resident.id}/stop").json()["confirmed"], "the Stop")
        assert resident.end_of(stopped["id"])["reason"]["code"] == "stopped"
        self._a_restart_keeps_the_latch_and_the_epoch(ground, resident, epoch)

    @staticmethod
    def _comes_twice_runs_once(ground: Ground, resident: Resident, epoch: int) -> int:
        move = MoveJoints(position_rad={"shoulder_pan": 0.6}, speed=1.0)
        order = ground.order(resident.agent, move, epoch=epoch)
        ground.deliver(resident.agent, order)
        wait_until(lambda: AckStatus.DONE in resident.acks(order.command), "its end")
        answers, ticks = resident.heard(order.command), len(resident.sent)
        ground.deliver(resident.agent, order)
        after = resident.take()  # an agent that still says that it has this command is asked anew
        wait_until(lambda: resident.heard(order.command) > answers, "the last answer, again")
        assert resident.acks(order.command)[-3:] == [AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE]
        assert len({position for _, position in resident.sent[ticks:]}) <= 1, "it moved again"
        return after

    @staticmethod
    def _a_restart_keeps_the_latch_and_the_epoch(ground: Ground, resident: Resident, epoch: int) -> None:
        resident.cell.stop()
        wait_until(lambda: not resident.get()["online"], "the goodbye")
        resident.start()
        wait_until(lambda: (state := resident.state()) is not None and state.stop is not None, "the latch")
        assert resident.move(FAR, epoch=epoch, wait_for="done")["reason"]["code"] == "lease_ended"
        again = resident.take()
        assert again > epoch
        assert resident.move(FAR, epoch=again, wait_for="done")["reason"]["code"] == "stopped"
        wait_until(lambda: ground.anna.post(f"/devices/{resident.id}/stop/reset").json()["confirmed"], "the reset")
        assert resident.move({"shoulder_pan": 0.0}, epoch=resident.take(), wait_for="done")["status"] == "done"

    def test_the_cloud_learns_how_long_messages_take(self, ground: Ground, resident: Resident, spoken: Spoken) -> None:
        found: list[dict[str, Any]] = []

        def told() -> bool:
            found[:] = ground.anna.get(f"/devices/{resident.id}/latency", params={"path": "device-cloud"}).json()[
                "items"
            ]
            return bool(found)

        wait_until(told, "samples of the agent's own")
        polling = spoken.configuration.get("http", HttpPolling())
        plain = "-poll" if polling.poll == "plain" else ""
        assert [each["transport"] for each in found] == [spoken.configuration.get("transport", "mqtt") + plain]
        assert found[0]["count"] >= 1
        assert found[0]["min_ms"] > 0

    def test_a_link_that_is_lost_in_motion_ends_it_and_nothing_resumes(
        self, ground: Ground, resident: Resident, spoken: Spoken
    ) -> None:
        epoch = resident.take()
        action = resident.move(FAR, speed=0.3, epoch=epoch, wait_for="started")
        wait_until(lambda: resident.at() > 0.3, "motion at full speed")
        before = len(resident.lost_s)
        ground.endpoints[spoken.endpoint].kill()
        wait_until(lambda: len(resident.lost_s) > before, "the loss", 4 * spoken.notices_s)
        lost_s = resident.lost_s[before]
        wait_until(lambda: not resident.device._controller.moving, "rest")
        moving = resident.moved_since(lost_s)
        assert len(moving) * catalogue.TYPES.load("ur5").period_ms <= HELD_WITHIN_MS, moving
        ground.endpoints[spoken.endpoint].revive()
        back_s = time.monotonic()
        wait_until(lambda: resident.links == [True, False, True], "the agent to be back")
        (last,) = [ack for ack in resident.journalled() if ack.id == action["id"]]
        assert last.reason is not None
        assert (last.status, last.reason.code) == (AckStatus.FAILED, "link_lost")
        if spoken.stores:
            assert resident.end_of(action["id"])["reason"]["code"] == "link_lost"
        time.sleep(0.5)
        assert resident.moved_since(back_s) == [], "nothing resumes"
        assert resident.take() > epoch
