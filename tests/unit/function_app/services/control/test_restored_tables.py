"""A backup of the tables is restored whose epochs are behind those of the device: its first command succeeds."""

import copy
from collections.abc import Callable, Iterator

import pytest

from device_agent.protocol import AckStatus, GrantLease, Mode, MoveJoints, Reason, State
from device_agent.runtime.authority.lease_gate import LeaseGate
from function_app.domain.control.lease import MAX_EPOCH_JUMP
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.memory import Memory
from tests.harness.cloud.polling import PollingRobot
from tests.unit.function_app.services.actions.queue_requests import queued

Restore = Callable[[], None]
Backup = Callable[[], Restore]


@pytest.fixture
def gate(robot: Robot) -> LeaseGate:
    """The epochs of the device."""
    robot.gate = LeaseGate()
    return robot.gate


@pytest.fixture
def backup(memory: Memory, gate: LeaseGate) -> Backup:
    """Copies the tables, and returns a function that restores them."""
    del gate  # before the first command

    def copied() -> Restore:
        rows = copy.deepcopy(memory.tables._partitions)

        def restore() -> None:
            memory.tables._partitions.clear()
            memory.tables._partitions.update(copy.deepcopy(rows))

        return restore

    return copied


def use(person: Person, robot: Robot, leases: int = 7) -> None:
    """Take and release control, as in ordinary operation."""
    for _ in range(leases):
        epoch = person.take_lease(robot.device).json()["epoch"]
        assert person.delete(f"/devices/{robot.device}/lease?epoch={epoch}").status_code == 204


def finishing(robot: Robot) -> None:
    robot.reports = lambda _: (AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE)


def publish_state(robot: Robot, gate: LeaseGate) -> None:
    now_ms = robot.cloud.clock.now_ms()
    state = State(device="arm", at_ms=now_ms, tick_ms=1, mode=Mode.IDLE, epoch=gate.epoch, ended_epoch=gate.burned)
    robot.publish_state(state)


class TestFirstCommand:
    """The cloud does not know the state of the device, or knows an outdated one."""

    def test_a_lease_is_granted(self, anna: Person, robot: Robot, backup: Backup, gate: LeaseGate) -> None:
        restore = backup()
        use(anna, robot)
        restore()
        answer = anna.take_lease(robot.device, wait_ms=5_000).json()
        assert (answer["confirmed"], answer["epoch"]) == (True, 8)
        assert gate.current(0) is not None
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"]["epoch"] == 8
        assert anna.take_lease(robot.device, epoch=8, wait_ms=5_000).json()["confirmed"] is True

    def test_a_lease_is_granted_if_the_epochs_are_equal(self, anna: Person, robot: Robot, backup: Backup) -> None:
        use(anna, robot, 3)
        restore = backup()
        use(anna, robot, 1)
        restore()
        answer = anna.take_lease(robot.device, wait_ms=5_000).json()
        assert (answer["confirmed"], answer["epoch"]) == (True, 5)

    @pytest.mark.parametrize("wait_ms", [0, 20_000])
    @pytest.mark.parametrize("leases", [1, 7])
    def test_an_action_runs(self, anna: Person, robot: Robot, backup: Backup, wait_ms: int, leases: int) -> None:
        restore = backup()
        use(anna, robot, leases)
        restore()
        finishing(robot)
        answer = anna.start(robot.device, wait_ms=wait_ms, wait_for="done")
        assert answer.status_code in {200, 202}
        action = anna.action(answer.json()["id"], wait_ms=20_000)
        assert (action["status"], action["reason"]) == ("done", None)
        assert len(robot.payloads[action["id"]]) == 2, "rejected once, then accepted"
        assert anna.start(robot.device, wait_ms=20_000, wait_for="done").json()["status"] == "done"

    def test_stop_and_reset_work(self, anna: Person, robot: Robot, backup: Backup, gate: LeaseGate) -> None:
        restore = backup()
        use(anna, robot)
        restore()
        assert anna.post(f"/devices/{robot.device}/stop").json()["outcome"] == "confirmed"
        assert anna.post(f"/devices/{robot.device}/stop/reset").json()["confirmed"] is True
        assert gate.epoch == 8

    def test_queued_actions_run(self, anna: Person, robot: Robot, backup: Backup) -> None:
        restore = backup()
        use(anna, robot)
        restore()
        first = anna.start(robot.device).json()["id"]
        second = queued(anna, robot.device)
        assert anna.action(first, wait_ms=20_000, wait_for="started")["status"] == "started"
        robot.report(first, AckStatus.DONE)
        assert anna.action(second, wait_ms=20_000, wait_for="started")["status"] == "started"

    def test_two_restores_in_a_row(self, anna: Person, robot: Robot, backup: Backup) -> None:
        finishing(robot)
        restore = backup()
        for _ in range(2):
            use(anna, robot)
            restore()
            assert anna.take_lease(robot.device, wait_ms=5_000).json()["confirmed"] is True
            restore()
            assert anna.start(robot.device, wait_ms=20_000, wait_for="done").json()["status"] == "done"


class TestKnownState:
    """The device has published its state since the restore."""

    def test_no_command_is_rejected(self, anna: Person, robot: Robot, backup: Backup, gate: LeaseGate) -> None:
        restore = backup()
        use(anna, robot)
        restore()
        publish_state(robot, gate)
        answer = anna.start(robot.device, wait_ms=20_000, wait_for="started").json()
        assert len(robot.payloads[answer["id"]]) == 1
        robot.report(answer["id"], AckStatus.DONE)
        assert anna.take_lease(robot.device, wait_ms=5_000).json()["epoch"] == 9

    def test_a_restored_lease_is_not_in_force(
        self, cloud: Cloud, anna: Person, robot: Robot, backup: Backup, gate: LeaseGate
    ) -> None:
        elsewhere = cloud.sign_in("anna")
        epoch = anna.take_lease(robot.device).json()["epoch"]
        restore = backup()
        anna.delete(f"/devices/{robot.device}/lease?epoch={epoch}")
        use(elsewhere, robot)
        restore()
        publish_state(robot, gate)
        problem(anna.take_lease(robot.device, epoch=epoch), 409, "lease-lost")
        problem(anna.start(robot.device, epoch=epoch), 409, "lease-lost")
        assert anna.get(f"/devices/{robot.device}/lease").json() == {"lease": None}
        assert elsewhere.take_lease(robot.device, wait_ms=5_000).json() | {"confirmed": True, "epoch": 9}


class TestRestoredLease:
    """The backup contains a lease that has ended since; the state of the device is unknown."""

    def test_a_renewal_fails_and_control_can_be_taken(self, anna: Person, robot: Robot, backup: Backup) -> None:
        epoch = anna.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
        restore = backup()
        anna.delete(f"/devices/{robot.device}/lease?epoch={epoch}")
        use(anna, robot)
        restore()
        lost = problem(anna.take_lease(robot.device, epoch=epoch, wait_ms=5_000), 409, "lease-lost")
        assert lost["epoch"] == epoch
        assert anna.take_lease(robot.device, wait_ms=5_000).json()["confirmed"] is True

    def test_an_action_without_an_epoch_runs(self, anna: Person, robot: Robot, backup: Backup) -> None:
        anna.take_lease(robot.device, lease_ms=600_000)
        restore = backup()
        use(anna, robot)
        restore()
        finishing(robot)
        assert anna.start(robot.device, wait_ms=20_000, wait_for="done").json()["status"] == "done"

    def test_an_action_with_the_epoch_of_the_lost_lease_does_not_run(
        self, anna: Person, robot: Robot, backup: Backup
    ) -> None:
        epoch = anna.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
        restore = backup()
        use(anna, robot)
        restore()
        finishing(robot)
        answer = anna.start(robot.device, epoch=epoch, wait_ms=20_000, wait_for="done").json()
        assert (answer["status"], answer["reason"]["code"]) == ("failed", "stale_epoch")
        assert len(robot.received(MoveJoints)) == 1


def test_a_lease_that_the_device_has_ended_is_not_replaced(anna: Person, robot: Robot, gate: LeaseGate) -> None:
    """After a hold, the operator must take control again; that is not a restored backup."""
    anna.take_lease(robot.device)
    gate.burn()
    answer = anna.start(robot.device, wait_ms=20_000, wait_for="done").json()
    assert (answer["status"], answer["reason"]["code"]) == ("failed", "lease_ended")
    assert len(robot.received(MoveJoints)) == 1


def test_a_renewal_that_the_device_rejects_in_its_epoch_is_not_confirmed(
    anna: Person, robot: Robot, gate: LeaseGate
) -> None:
    """The device ended the lease after a hold, so this is not a restored backup."""
    anna.take_lease(robot.device)
    gate.burn()
    answer = anna.take_lease(robot.device, epoch=1, wait_ms=5_000)
    assert (answer.status_code, answer.json()["confirmed"]) == (200, False)
    assert len(robot.received(GrantLease)) == 2, "it is not sent again"


class TestForgery:
    """A hostile broker forges states and rejections."""

    def test_a_forged_state_raises_the_epoch_by_a_bounded_step(
        self, anna: Person, robot: Robot, gate: LeaseGate
    ) -> None:
        epochs = []
        for _ in range(3):
            now_ms = robot.cloud.clock.now_ms()
            forged = State(device="arm", at_ms=now_ms, tick_ms=1, mode=Mode.IDLE, epoch=2**53, ended_epoch=2**53)
            robot.publish_state(forged)
            answer = anna.take_lease(robot.device, wait_ms=5_000).json()
            assert answer["confirmed"] is True
            epochs.append(answer["epoch"])
        assert gate.epoch == epochs[-1]
        assert epochs[-1] <= 3 * (MAX_EPOCH_JUMP + 2)

    def test_a_forged_rejection_raises_the_epoch_once_and_the_action_runs_once(
        self, anna: Person, robot: Robot, gate: LeaseGate
    ) -> None:
        started = anna.start(robot.device, wait_ms=20_000, wait_for="started").json()
        forged = Reason(code="stale_epoch", message="forged", epoch=2**53)
        for _ in range(2):
            robot.report(started["id"], AckStatus.FAILED, reason=forged)
        assert len(robot.received(MoveJoints)) == 1
        assert gate.epoch == 1
        assert anna.action(started["id"])["status"] == "failed"
        finishing(robot)
        assert anna.start(robot.device, wait_ms=20_000, wait_for="done").json()["status"] == "done"
        assert gate.epoch <= MAX_EPOCH_JUMP + 4

    def test_a_rejection_after_a_takeover_is_final(self, anna: Person, robot: Robot, gate: LeaseGate) -> None:
        robot.reports = lambda _: (AckStatus.RECEIVED,)
        action = anna.start(robot.device).json()["id"]
        queued(anna, robot.device)
        assert anna.post(f"/devices/{robot.device}/stop/reset").json()["confirmed"] is True
        reason = Reason(code="stale_epoch", message="from lease 1, but lease 2 is in force", epoch=gate.epoch)
        robot.report(action, AckStatus.FAILED, reason=reason)
        shown = anna.action(action, wait_ms=20_000)
        assert (shown["status"], shown["reason"]["code"]) == ("failed", "stale_epoch")


@pytest.fixture
def polling(cloud: Cloud, anna: Person) -> Iterator[PollingRobot]:
    """A device whose agent polls, and that has seen epoch 7."""
    with PollingRobot(cloud) as robot:
        robot.pair(anna)
        robot.gate = LeaseGate(epoch=7, burned=7)
        finishing(robot)
        yield robot.open_link()


def test_a_polling_agent_gets_the_command_again(anna: Person, polling: PollingRobot) -> None:
    action = anna.start(polling.device).json()["id"]
    for _ in range(2):
        polling.step()
    assert [command.epoch for command in polling.received(MoveJoints)] == [1, 8]
    assert anna.action(action)["status"] == "done"
    result = anna.begin("POST", f"/devices/{polling.device}/lease", json={"wait_ms": 20_000})
    polling.step()
    assert result().json()["epoch"] == 9


def test_a_polling_agent_gets_a_second_grant(anna: Person, polling: PollingRobot) -> None:
    result = anna.begin("POST", f"/devices/{polling.device}/lease", json={"wait_ms": 20_000})
    polling.step()
    polling.step(wait_ms=1_000)
    assert {"confirmed": True, "epoch": 8}.items() <= result().json().items()
