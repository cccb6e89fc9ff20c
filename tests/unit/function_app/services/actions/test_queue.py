"""Queued actions start in order; a failure or Stop cancels the queue."""

from device_agent.protocol import AckStatus, CancelAction, MoveJoints, ResetStop, codec, topics
from function_app.domain.actions.action import GRACE_MS
from function_app.domain.actions.queue import MAX_QUEUED
from function_app.services.actions.queue import CHECK_MS
from tests.fakes.agent import Robot
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import MOVE, Cloud, Person, problem
from tests.unit.function_app.services.actions.queue_requests import QUEUE, pass_time, queued, reason, sent, started


class TestTurns:
    def test_actions_start_in_order_after_the_previous_end(self, anna: Person, robot: Robot, running: str) -> None:
        waiting = [queued(anna, robot.device) for _ in range(3)]
        problem(anna.start(robot.device), 409, "device-busy")
        assert [anna.action(action)["queue_position"] for action in waiting] == [1, 2, 3]
        items = anna.get(f"/devices/{robot.device}/actions").json()["items"]
        assert {item["id"]: item["queue_position"] for item in items} == {
            running: None,
            **{action: place for place, action in enumerate(waiting, start=1)},
        }
        for before, action in zip([running, *waiting[:-1]], waiting, strict=True):
            assert sent(robot)[-1] == before
            robot.report(before, AckStatus.DONE)
            assert started(anna, action)
            assert anna.action(before)["status"] == "done"
        assert sent(robot) == [running, *waiting]
        assert [len(robot.payloads[action]) for action in waiting] == [1, 1, 1], "sent once each"

    def test_a_free_device_starts_at_once(self, anna: Person, robot: Robot) -> None:
        answer = anna.start(robot.device, wait_ms=10_000, **QUEUE)
        assert (answer.status_code, answer.json()["status"]) == (200, "started")
        assert answer.json()["queue_position"] is None

    def test_a_call_may_wait_for_its_turn(self, anna: Person, robot: Robot, running: str) -> None:
        body = {"request": MOVE, "wait_ms": 20_000, **QUEUE}
        call = anna.begin("POST", f"/devices/{robot.device}/actions", json=body)
        robot.report(running, AckStatus.DONE)
        answer = call()
        assert (answer.status_code, answer.json()["status"]) == (200, "started")
        assert {"created_ms", "published_ms", "started_ms"} <= set(answer.json()["times"])

    def test_the_queue_is_bounded(self, anna: Person, robot: Robot, running: str) -> None:
        waiting = [queued(anna, robot.device) for _ in range(MAX_QUEUED)]
        problem(anna.start(robot.device, **QUEUE), 409, "queue-full")
        anna.post(f"/actions/{waiting[5]}/cancel")
        queued(anna, robot.device)
        assert sent(robot) == [running]

    def test_time_limits_count_from_the_turn(self, anna: Person, robot: Robot, running: str) -> None:
        action = queued(anna, robot.device, ttl_ms=2_000, timeout_ms=60_000)
        anna.cloud.clock.advance(100)
        robot.report(running, AckStatus.DONE)
        assert started(anna, action)
        command = robot.received(MoveJoints)[-1]
        assert command.issued_at_ms >= anna.cloud.clock.now_ms() - 60_000
        assert command.ttl_ms == 2_000
        anna.cloud.sweep()
        assert anna.action(action)["status"] == "started"

    def test_an_action_that_did_not_arrive_expires_and_the_next_starts(
        self, anna: Person, robot: Robot, running: str
    ) -> None:
        first, second = queued(anna, robot.device, ttl_ms=2_000), queued(anna, robot.device)
        robot.silent = True
        robot.report(running, AckStatus.DONE)
        assert sent(robot) == [running, first]
        anna.cloud.clock.advance(2)
        robot.forget(first)
        robot.silent = False
        pass_time(anna.cloud, 2, step_s=0.5)
        assert anna.action(first)["status"] == "expired"
        assert sent(robot) == [running, first, second]

    def test_an_unknown_outcome_cancels_the_queue(self, anna: Person, robot: Robot, running: str) -> None:
        first, second = queued(anna, robot.device, ttl_ms=2_000), queued(anna, robot.device)
        robot.silent = True
        robot.report(running, AckStatus.DONE)
        pass_time(anna.cloud, 2 + GRACE_MS / 1000 + 1, step_s=0.5)
        assert reason(anna, first) == ("unknown", "no-report")
        assert reason(anna, second) == ("cancelled", "earlier-unknown")
        robot.silent = False
        third = anna.start(robot.device, wait_ms=10_000).json()["id"]
        robot.report(first, AckStatus.DONE)
        assert anna.action(first)["status"] == "done"
        assert started(anna, third), "the late report does not affect the next action"

    def test_an_idempotency_key_is_valid_while_queued_and_after(self, anna: Person, robot: Robot, running: str) -> None:
        action = queued(anna, robot.device, idempotency_key="k")
        assert queued(anna, robot.device, idempotency_key="k") == action
        problem(anna.start(robot.device, idempotency_key="k", queue_ms=5_000, **QUEUE), 422, "idempotency-key-reused")
        robot.report(running, AckStatus.DONE)
        assert anna.start(robot.device, idempotency_key="k", **QUEUE).json()["id"] == action
        assert started(anna, action)
        assert sent(robot) == [running, action]


class TestLeases:
    def test_with_an_epoch_it_runs_under_that_lease_or_fails(self, anna: Person, robot: Robot) -> None:
        epoch = anna.take_lease(robot.device).json()["epoch"]
        problem(anna.cloud.sign_in("anna").start(robot.device, **QUEUE), 409, "lease-held")
        first = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
        second, third = queued(anna, robot.device, epoch=epoch), queued(anna, robot.device, epoch=epoch)
        robot.report(first, AckStatus.DONE)
        assert started(anna, second)
        assert anna.action(second)["epoch"] == epoch
        anna.take_lease(robot.device)
        robot.report(second, AckStatus.DONE)
        assert reason(anna, third) == ("failed", "lease-lost")
        problem(anna.start(robot.device, epoch=epoch, **QUEUE), 409, "lease-lost")

    def test_after_an_expired_lease_the_next_has_its_turn(self, anna: Person, robot: Robot) -> None:
        epoch = anna.take_lease(robot.device, lease_ms=1_000).json()["epoch"]
        first = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
        lost, free = queued(anna, robot.device, epoch=epoch), queued(anna, robot.device)
        anna.cloud.clock.advance(2)
        robot.report(first, AckStatus.DONE)
        assert started(anna, free)
        assert reason(anna, lost) == ("failed", "lease-lost")
        assert sent(robot) == [first, free]

    def test_without_an_epoch_it_gets_its_own_lease(self, anna: Person, robot: Robot, running: str) -> None:
        other = anna.cloud.sign_in("anna")
        action = queued(other, robot.device)
        assert other.action(action)["epoch"] == 0
        robot.report(running, AckStatus.DONE)
        assert started(other, action)
        assert other.action(action)["epoch"] == robot.received(MoveJoints)[-1].epoch > anna.action(running)["epoch"]
        robot.report(action, AckStatus.DONE)
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None

    def test_a_lease_acquired_meanwhile_is_kept(self, anna: Person, robot: Robot, running: str) -> None:
        action = queued(anna.cloud.sign_in("anna"), robot.device)
        assert anna.take_lease(robot.device).status_code == 200
        robot.report(running, AckStatus.DONE)
        assert reason(anna, action) == ("failed", "lease-held")
        assert sent(robot) == [running]


class TestEnds:
    def test_a_queued_action_is_cancelled_at_once(self, anna: Person, robot: Robot, running: str) -> None:
        first, second, third = (queued(anna, robot.device) for _ in range(3))
        answer = anna.post(f"/actions/{second}/cancel")
        assert (answer.status_code, answer.json()["status"]) == (202, "cancelled")
        assert answer.json()["reason"]["code"] == "cancelled"
        assert [anna.action(action)["queue_position"] for action in (first, second, third)] == [1, None, 2]
        assert robot.received(CancelAction) == []
        anna.post(f"/actions/{running}/cancel")
        robot.report(running, AckStatus.CANCELLED)
        assert started(anna, first), "after a cancelled action too"
        robot.report(first, AckStatus.DONE)
        assert started(anna, third)
        assert sent(robot) == [running, first, third]

    def test_an_action_expires_without_a_turn_in_time(self, anna: Person, robot: Robot, running: str) -> None:
        first, second = queued(anna, robot.device, queue_ms=20_000), queued(anna, robot.device, queue_ms=10_000)
        pass_time(anna.cloud, 9)
        assert [anna.action(action)["status"] for action in (first, second)] == ["queued", "queued"]
        pass_time(anna.cloud, 2)
        assert reason(anna, second) == ("expired", "queue-timeout")
        assert anna.action(first)["queue_position"] == 1
        anna.cloud.clock.advance(10)
        robot.report(running, AckStatus.DONE)
        assert reason(anna, first) == ("expired", "queue-timeout"), "it expired in the queue"
        assert sent(robot) == [running]

    def test_a_failure_cancels_the_queue(self, anna: Person, robot: Robot, running: str) -> None:
        waiting = [queued(anna, robot.device) for _ in range(3)]
        robot.fail(running, "held", "The arm had to hold.")
        assert {reason(anna, action) for action in waiting} == {("cancelled", "earlier-failed")}
        assert anna.start(robot.device, wait_ms=10_000).status_code == 200
        assert len(sent(robot)) == 2

    def test_a_stop_cancels_the_queue_and_nothing_resumes(self, anna: Person, robot: Robot, running: str) -> None:
        waiting = [queued(anna, robot.device) for _ in range(3)]
        assert anna.post(f"/devices/{robot.device}/stop", {"reason": "look out"}).status_code == 200
        assert {reason(anna, action) for action in waiting} == {("cancelled", "stopped")}
        robot.fail(running, "stopped", "The device was stopped.")
        assert anna.post(f"/devices/{robot.device}/stop/reset").status_code == 200
        assert robot.received(ResetStop)
        pass_time(anna.cloud, 2 * CHECK_MS / 1000 + 1)
        assert sent(robot) == [running]


def test_acks_about_unsent_actions_are_ignored(anna: Person, robot: Robot, running: str) -> None:
    action = queued(anna, robot.device)
    robot.report(action, AckStatus.DONE)
    robot.report(running, AckStatus.DONE)
    assert started(anna, action)


def test_concurrent_acks_start_the_next_once(open_cloud: OpenCloud, anna: Person, robot: Robot, running: str) -> None:
    waiting = [queued(anna, robot.device) for _ in range(4)]
    instances: list[Cloud] = [anna.cloud, *(open_cloud() for _ in range(3))]
    topic = topics.parse(robot.topic(topics.ACK))
    for before, action in zip([running, *waiting[:-1]], waiting, strict=True):
        done = codec.encode(robot.ack(before, AckStatus.DONE))
        for call in [each.begin(each.functions.action_acks.ingest(topic, done, by="mqtt")) for each in instances]:
            call()
        assert started(anna, action)
    assert sent(robot) == [running, *waiting]
