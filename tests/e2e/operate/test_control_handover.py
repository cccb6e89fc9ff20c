"""Control handover of a moving simulated arm with the real agent: the arm holds at once."""

import contextlib
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.harness.browser.product import Api, Machine
from tests.harness.browser.steering import assert_at_rest, commanded_speed
from tests.harness.network.brokers import wait_until

FAR, NEAR = {"shoulder_pan": 2.0}, {"shoulder_pan": -2.0}
SLOW = 0.05
"""Speed share; a motion takes about 12 s, so that the arm still moves on a busy machine."""


@pytest.fixture
def two(machine: Machine) -> Iterator[tuple[Api, Api, str]]:
    """Two sessions of one owner and the arm, which is free and not stopped before and after."""
    with machine.api() as ann, machine.api() as bob:
        device = ann.device()["id"]
        wait_until(lambda: ann.device()["lease"] is None, "the end of the lease of an earlier page")
        yield ann, bob, device
        with contextlib.suppress(AssertionError):
            ann.post(f"/devices/{device}/stop/reset")


def move(api: Api, device: str, epoch: int, target: dict[str, float]) -> str:
    """Start a slow motion. Returns the action once the arm moves."""
    request = {"kind": "move_joints", "position_rad": target, "speed": SLOW}
    body = {"request": request, "epoch": epoch, "wait_ms": 10_000}
    action: str = api.post(f"/devices/{device}/actions", body)["id"]
    return action


def state(api: Api, device: str) -> dict[str, Any]:
    body: dict[str, Any] = api.get(f"/devices/{device}")["state"]
    return body


def ended(api: Api, action: str) -> dict[str, Any]:
    body: dict[str, Any] = api.get(f"/actions/{action}", wait_ms=20_000, wait_for="done")
    return body


def kinds(api: Api, device: str) -> set[str]:
    return {item["kind"] for item in api.get(f"/devices/{device}/events", limit=50)["items"]}


def refused(api: Api, path: str, body: Any) -> str:
    answer = api.http.post(path, json=body)
    assert answer.status_code == httpx.codes.CONFLICT, answer.text
    code: str = answer.json()["type"].rpartition("/")[2]
    return code


def test_a_handover_stops_the_arm_and_the_former_holder_cannot_move_it(
    machine: Machine, two: tuple[Api, Api, str]
) -> None:
    ann, bob, device = two
    trace = machine.trace()
    epoch = ann.post(f"/devices/{device}/lease", {"lease_ms": 60_000})["epoch"]
    action = move(ann, device, epoch, FAR)
    wait_until(lambda: commanded_speed(trace) > SLOW / 10, "motion")
    requested = bob.post(f"/devices/{device}/lease/requests", {"lease_ms": 60_000})
    assert requested["confirmed"] is True
    request = requested["request"]["id"]
    wait_until(lambda: (state(ann, device)["lease"] or {}).get("request"), "the request in the device's state")
    assert state(ann, device)["lease"]["request"]["id"] == request
    assert commanded_speed(trace) > 0, "a request does not affect the motion"
    granted = ann.post(f"/devices/{device}/lease/requests/{request}/accept")
    assert (granted["epoch"], granted["confirmed"]) == (epoch + 1, True)
    last = ended(ann, action)
    assert (last["status"], last["reason"]["code"]) == ("failed", "lease_lost")
    wait_until(lambda: commanded_speed(trace) == 0, "rest")
    wait_until(lambda: state(bob, device)["lease"]["epoch"] == epoch + 1, "the new holder in the state")
    request_body = {"request": {"kind": "move_joints", "position_rad": FAR}, "epoch": epoch}
    assert refused(ann, f"/devices/{device}/actions", request_body) == "lease-lost"
    taken = ann.post(f"/devices/{device}/lease", {"take_over": True, "reason": "test"})
    assert (taken["epoch"], taken["confirmed"]) == (epoch + 2, True)
    wait_until(lambda: state(bob, device)["lease"]["reason"] == "test", "the reason in the state")
    ann.http.delete(f"/devices/{device}/lease", params={"epoch": epoch + 2})


def test_after_stop_all_motion_needs_new_control(machine: Machine, two: tuple[Api, Api, str]) -> None:
    ann, bob, device = two
    trace = machine.trace()
    epoch = ann.post(f"/devices/{device}/lease", {"lease_ms": 60_000})["epoch"]
    action = move(ann, device, epoch, NEAR)
    wait_until(lambda: commanded_speed(trace) > SLOW / 10, "motion")
    answer = bob.post("/stop", {"reason": "test"})
    assert [item["confirmed"] for item in answer["items"] if item["device"] == device] == [True]
    assert ended(ann, action)["reason"]["code"] == "stopped"
    wait_until(lambda: commanded_speed(trace) == 0, "rest")
    wait_until(lambda: state(ann, device)["stop"], "the latch in the state")
    # The device ended Ann's lease, so control is free; a stopped device rejects motion.
    wait_until(lambda: ann.get(f"/devices/{device}/lease")["lease"] is None, "the end of the lease")
    other = bob.post(f"/devices/{device}/lease", {"lease_ms": 60_000})["epoch"]
    still = ended(bob, move(bob, device, other, NEAR))
    assert (still["status"], still["reason"]["code"]) == ("failed", "stopped")
    wait_until(lambda: ann.post(f"/devices/{device}/stop/reset")["confirmed"], "the reset")
    request_body = {"request": {"kind": "move_joints", "position_rad": NEAR}, "epoch": other}
    assert refused(bob, f"/devices/{device}/actions", request_body) == "lease-lost"
    assert_at_rest(trace)  # the reset resumes nothing
    new_epoch = bob.post(f"/devices/{device}/lease", {"lease_ms": 60_000})["epoch"]
    again = move(bob, device, new_epoch, NEAR)
    wait_until(lambda: commanded_speed(trace) > SLOW / 10, "motion")
    bob.post(f"/actions/{again}/cancel")
    ended(bob, again)
    bob.http.delete(f"/devices/{device}/lease", params={"epoch": new_epoch})
    expected = {"stop-ordered", "stop-latched", "stop-reset-ordered", "stop-reset", "control-taken"}
    # Events of the device arrive when its link is stable.
    wait_until(lambda: expected <= kinds(ann, device), "the events of cloud and device")
