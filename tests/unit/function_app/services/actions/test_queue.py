"""Actions that wait for their turn: first come, first served; after something went wrong nothing starts by itself."""

from device_agent.protocol import AckStatus, CancelAction, MoveJoints, ResetStop, codec, topics
from function_app.domain.actions.action import GRACE_MS
from function_app.domain.actions.queue import MAX_QUEUED
from function_app.services.actions.queue import LOOK_MS
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import Cloud, problem
from tests.harness.network.brokers import wait_until
from tests.unit.function_app.services.actions.queue_requests import (
    QUEUE,
    Pair,
    pass_time,
    queued,
    reason,
    sent,
    statuses,
)


class TestTurns:
    def test_they_start_in_order_each_when_the_one_before_has_ended(self, pair: Pair, running: str) -> None:
        anna, robot = pair
        waiting = [queued(anna, robot.device) for _ in range(3)]
        assert [anna.action(action)["queue_position"] for action in waiting] == [1, 2, 3]
        listed = {item["id"]: item for item in anna.get(f"/devices/{robot.device}/actions").json()["items"]}
        assert [listed[action]["queue_position"] for action in waiting] == [1, 2, 3]
        assert listed[running]["queue_position"] is None
        for before, action in zip([running, *waiting[:-1]], waiting, strict=True):
            assert sent(robot)[-1] == before
            robot.report(before, AckStatus.DONE)
            assert anna.action(action, wait_ms=20_000, wait_for="started")["status"] == "started"
            assert anna.action(before)["status"] == "done"
        assert sent(robot) == [running, *waiting]
        assert [len(robot.payloads[action]) for action in waiting] == [1, 1, 1], "sent once each"

    def test_a_free_device_runs_it_at_once(self, pair: Pair) -> None:
        anna, robot = pair
        answer = anna.start(robot.device, wait_ms=10_000, **QUEUE)
        assert (answer.status_code, answer.json()["status"]) == (200, "started")
        assert answer.json()["queue_position"] is None

    def test_the_call_may_wait_for_the_turn_and_is_told_of_success_only_then(self, pair: Pair, running: str) -> None:
        anna, robot = pair
        body = {"request": {"kind": "move_joints", "position_rad": {"elbow": 0.5}}, "wait_ms": 20_000, **QUEUE}
        answer = anna.begin("POST", f"/devices/{robot.device}/actions", json=body)
        wait_until(lambda: len(anna.get(f"/devices/{robot.device}/actions").json()["items"]) == 2, "the second")
        robot.report(running, AckStatus.DONE)
        assert (answer().status_code, answer().json()["status"]) == (200, "started")
        assert {"created_ms", "published_ms", "started_ms"} <= set(answer().json()["times"])

    def test_a_start_that_does_not_wait_is_refused_and_does_not_overtake(self, pair: Pair, running: str) -> None:
        anna, robot = pair
        queued(anna, robot.device)
        assert problem(anna.start(robot.device), 409, "device-busy")["action"] == running

    def test_only_so_many_may_wait(self, pair: Pair, running: str) -> None:
        anna, robot = pair
        waiting = [queued(anna, robot.device) for _ in range(MAX_QUEUED)]
        problem(anna.start(robot.device, **QUEUE), 409, "queue-full")
        anna.post(f"/actions/{waiting[5]}/cancel")
        queued(anna, robot.device)
        assert sent(robot) == [running]

    def test_time_to_live_and_time_limit_count_from_the_turn(self, cloud: Cloud, pair: Pair, running: str) -> None:
        anna, robot = pair
        action = queued(anna, robot.device, ttl_ms=2_000, timeout_ms=60_000)
        cloud.clock.advance(100)
        robot.report(running, AckStatus.DONE)
        found = anna.action(action, wait_ms=20_000, wait_for="started")
        assert found["status"] == "started"
        command = robot.heard(MoveJoints)[-1]
        assert command.issued_at_ms >= cloud.clock.now_ms() - 60_000
        assert command.ttl_ms == 2_000
        cloud.sweep()
        assert anna.action(action)["status"] == "started"

    def test_an_unaccepted_action_expires_and_the_next_starts(self, cloud: Cloud, pair: Pair, running: str) -> None:
        anna, robot = pair
        first, second = queued(anna, robot.device, ttl_ms=2_000), queued(anna, robot.device)
        robot.silent = True
        robot.report(running, AckStatus.DONE)
        wait_until(lambda: first in sent(robot), "the first")
        pass_time(cloud, 2 + GRACE_MS / 1000 + 1, step_s=0.5)
        assert reason(anna, first) == ("expired", "no-answer")
        wait_until(lambda: second in sent(robot), "the second")
        assert len(set(robot.payloads[first])) == 1

    def test_the_same_key_is_the_same_action_while_it_waits_and_after(self, pair: Pair, running: str) -> None:
        anna, robot = pair
        action = queued(anna, robot.device, once="k")
        assert queued(anna, robot.device, once="k") == action
        problem(anna.start(robot.device, once="k", queue_ms=5_000, **QUEUE), 422, "idempotency-key-reused")
        robot.report(running, AckStatus.DONE)
        again = anna.start(robot.device, once="k", **QUEUE)
        assert again.json()["id"] == action
        assert anna.action(action, wait_ms=20_000, wait_for="started")["status"] == "started"
        assert sent(robot) == [running, action]


class TestLeases:
    def test_with_an_epoch_it_runs_under_that_lease(self, pair: Pair) -> None:
        anna, robot = pair
        epoch = anna.take(robot.device).json()["epoch"]
        first = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
        action = queued(anna, robot.device, epoch=epoch)
        robot.report(first, AckStatus.DONE)
        assert anna.action(action, wait_ms=20_000, wait_for="started")["epoch"] == epoch

    def test_when_that_lease_is_lost_it_fails_and_the_next_has_its_turn(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        epoch = anna.take(robot.device, lease_ms=1_000).json()["epoch"]
        first = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
        lost, free = queued(anna, robot.device, epoch=epoch), queued(anna, robot.device)
        cloud.clock.advance(2)
        robot.report(first, AckStatus.DONE)
        assert anna.action(free, wait_ms=20_000, wait_for="started")["status"] == "started"
        assert reason(anna, lost) == ("failed", "lease-lost")
        assert sent(robot) == [first, free]

    def test_a_lease_of_another_epoch_does_not_do(self, pair: Pair) -> None:
        anna, robot = pair
        epoch = anna.take(robot.device).json()["epoch"]
        first = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
        action = queued(anna, robot.device, epoch=epoch)
        anna.take(robot.device)
        robot.report(first, AckStatus.DONE)
        assert anna.action(action, wait_ms=20_000)["status"] == "failed"
        assert reason(anna, action) == ("failed", "lease-lost")
        problem(anna.start(robot.device, epoch=epoch, **QUEUE), 409, "lease-lost")

    def test_it_waits_behind_an_action_and_gets_a_lease_of_its_own(
        self, cloud: Cloud, pair: Pair, running: str
    ) -> None:
        anna, robot = pair
        other = cloud.sign_in("anna")
        action = queued(other, robot.device)
        assert other.action(action)["epoch"] == 0
        robot.report(running, AckStatus.DONE)
        found = other.action(action, wait_ms=20_000, wait_for="started")
        assert found["epoch"] == robot.heard(MoveJoints)[-1].epoch > anna.action(running)["epoch"]
        robot.report(action, AckStatus.DONE)
        other.action(action, wait_ms=20_000)
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None

    def test_it_does_not_wait_for_a_person_to_let_go(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        other = cloud.sign_in("anna")
        epoch = anna.take(robot.device).json()["epoch"]
        anna.start(robot.device, epoch=epoch, wait_ms=10_000)
        problem(other.start(robot.device, **QUEUE), 409, "lease-held")

    def test_who_has_taken_control_meanwhile_keeps_it(self, cloud: Cloud, pair: Pair, running: str) -> None:
        anna, robot = pair
        other = cloud.sign_in("anna")
        action = queued(other, robot.device)
        assert anna.take(robot.device).status_code == 200
        robot.report(running, AckStatus.DONE)
        assert anna.action(action, wait_ms=20_000)["status"] == "failed"
        assert reason(anna, action) == ("failed", "lease-held")
        assert sent(robot) == [running]


class TestEnds:
    def test_cancelling_one_that_waits_ends_it_at_once(self, pair: Pair, running: str) -> None:
        anna, robot = pair
        first, second, third = (queued(anna, robot.device) for _ in range(3))
        answer = anna.post(f"/actions/{second}/cancel")
        assert (answer.status_code, answer.json()["status"]) == (202, "cancelled")
        assert answer.json()["reason"]["code"] == "cancelled"
        assert [anna.action(action)["queue_position"] for action in (first, second, third)] == [1, None, 2]
        assert robot.heard(CancelAction) == []
        robot.report(running, AckStatus.DONE)
        anna.action(first, wait_ms=20_000, wait_for="started")
        robot.report(first, AckStatus.DONE)
        assert anna.action(third, wait_ms=20_000, wait_for="started")["status"] == "started"
        assert sent(robot) == [running, first, third]

    def test_cancelling_the_one_that_runs_gives_the_next_its_turn(self, pair: Pair, running: str) -> None:
        anna, robot = pair
        action = queued(anna, robot.device)
        anna.post(f"/actions/{running}/cancel")
        robot.report(running, AckStatus.CANCELLED)
        assert anna.action(action, wait_ms=20_000, wait_for="started")["status"] == "started"

    def test_whose_turn_does_not_come_in_time_expires(self, cloud: Cloud, pair: Pair, running: str) -> None:
        anna, robot = pair
        first, second = queued(anna, robot.device), queued(anna, robot.device, queue_ms=10_000)
        pass_time(cloud, 9)
        assert statuses(anna, first, second) == ["queued", "queued"]
        pass_time(cloud, 2)
        assert reason(anna, second) == ("expired", "queue-timeout")
        assert anna.action(first)["queue_position"] == 1
        robot.report(running, AckStatus.DONE)
        assert anna.action(first, wait_ms=20_000, wait_for="started")["status"] == "started"

    def test_a_turn_that_comes_too_late_is_none(self, cloud: Cloud, pair: Pair, running: str) -> None:
        anna, robot = pair
        late = queued(anna, robot.device, queue_ms=10_000)
        cloud.clock.advance(11)
        robot.report(running, AckStatus.DONE)
        assert anna.action(late, wait_ms=20_000)["status"] == "expired"
        assert sent(robot) == [running]

    def test_after_a_failure_nothing_goes_on_by_itself(self, pair: Pair, running: str) -> None:
        anna, robot = pair
        waiting = [queued(anna, robot.device) for _ in range(3)]
        robot.fail(running, "held", "The arm had to hold.")
        assert anna.action(waiting[-1], wait_ms=20_000)["status"] == "cancelled"
        assert {reason(anna, action) for action in waiting} == {("cancelled", "earlier-failed")}
        assert anna.start(robot.device, wait_ms=10_000).status_code == 200
        assert len(sent(robot)) == 2

    def test_what_was_lost_is_a_failure_too(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        anna.start(robot.device, wait_ms=10_000, timeout_ms=5_000)
        action = queued(anna, robot.device)
        pass_time(cloud, 6)
        assert reason(anna, action) == ("cancelled", "earlier-failed")

    def test_a_stop_empties_the_queue_and_nothing_resumes(self, cloud: Cloud, pair: Pair, running: str) -> None:
        anna, robot = pair
        waiting = [queued(anna, robot.device) for _ in range(3)]
        assert anna.post(f"/devices/{robot.device}/stop", {"reason": "look out"}).status_code == 200
        assert {reason(anna, action) for action in waiting} == {("cancelled", "stopped")}
        robot.fail(running, "stopped", "The device was stopped.")
        assert anna.post(f"/devices/{robot.device}/stop/reset").status_code == 200
        wait_until(lambda: robot.heard(ResetStop), "the reset")
        pass_time(cloud, 2 * LOOK_MS / 1000 + 1)
        assert sent(robot) == [running]


def test_a_device_cannot_report_about_what_it_was_never_sent(pair: Pair, running: str) -> None:
    anna, robot = pair
    action = queued(anna, robot.device)
    robot.report(action, AckStatus.DONE)
    robot.report(running, AckStatus.DONE)
    assert anna.action(action, wait_ms=20_000, wait_for="started")["status"] == "started"


def test_many_that_see_the_end_at_once_start_the_next_once(
    open_cloud: OpenCloud, cloud: Cloud, pair: Pair, running: str
) -> None:
    anna, robot = pair
    waiting = [queued(anna, robot.device) for _ in range(4)]
    processes = [open_cloud(clock=cloud.clock) for _ in range(3)]
    for before, action in zip([running, *waiting[:-1]], waiting, strict=True):
        done = codec.encode(robot.ack(before, AckStatus.DONE))
        topic = topics.parse(robot.topic(topics.ACK))
        calls = [process.begin(process.functions.action_acks.ingest(topic, done)) for process in (cloud, *processes)]
        for finish in calls:
            finish()
        assert anna.action(action, wait_ms=20_000, wait_for="started")["status"] == "started"
    assert sent(robot) == [running, *waiting]
