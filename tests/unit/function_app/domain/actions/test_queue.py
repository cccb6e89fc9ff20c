"""The queue of a device: order, limit, and actions that are cancelled together."""

import pytest

from function_app.domain.actions.queue import MAX_QUEUED, ActionQueue
from function_app.domain.common.problems import Problem

QUEUE = ActionQueue("p", ("a", "b", "c"), {"x": "stopped"})


def test_actions_wait_in_their_order() -> None:
    queue = ActionQueue("p").with_last("a").with_last("b")
    assert queue == ActionQueue("p", ("a", "b"))
    assert [QUEUE.position(action) for action in ("a", "c", "x", "other")] == [1, 3, None, None]
    assert [QUEUE.contains(action) for action in ("a", "x", "other")] == [True, True, False]
    assert [
        queue.empty for queue in (ActionQueue("p"), ActionQueue("p", ("a",)), ActionQueue("p", (), {"x": "y"}))
    ] == [True, False, False]


def test_a_full_queue_rejects_an_action() -> None:
    almost = ActionQueue("p", tuple(map(str, range(MAX_QUEUED - 1))))
    full = almost.with_last("last")
    with pytest.raises(Problem) as problem:
        full.with_last("more")
    assert (problem.value.code, problem.value.status) == ("queue-full", 409)


def test_an_action_is_removed_from_waiting_and_cancelled_ones() -> None:
    assert QUEUE.without("b") == ActionQueue("p", ("a", "c"), {"x": "stopped"})
    assert QUEUE.without("x") == ActionQueue("p", ("a", "b", "c"))
    assert QUEUE.without("other") == QUEUE


def test_waiting_actions_are_cancelled_with_a_code() -> None:
    assert QUEUE.with_cancelled(["c", "a", "x"], "moved") == ActionQueue(
        "p", ("b",), {"x": "stopped", "a": "moved", "c": "moved"}
    )
    assert QUEUE.with_cancelled(["x", "other"], "moved") is QUEUE
    assert QUEUE.with_all_cancelled("moved") == ActionQueue(
        "p", (), {"x": "stopped", "a": "moved", "b": "moved", "c": "moved"}
    )
