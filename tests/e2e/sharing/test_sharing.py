"""Access to a shared arm is revoked while a guest moves it: the real agent holds it at once."""

import time

import httpx

from tests.harness.browser.product import Machine, Trace
from tests.harness.network.brokers import wait_until


def target_rad(trace: Trace) -> float:
    found: float = trace.now()["target"]["shoulder_pan"]
    return found


def test_revoking_a_moving_guest_stops_the_arm(machine: Machine) -> None:
    trace = machine.trace()
    with machine.api() as owner, machine.api("guest") as guest:
        device = owner.device()["id"]
        made = owner.post(f"/devices/{device}/invitations", {"role": "operator"})
        guest.post("/invitations/redeem", {"secret": made["secret"]})
        assert guest.device()["role"] == "operator"
        begin_rad = target_rad(trace)
        request = {
            "kind": "move_joints",
            "position_rad": {"shoulder_pan": -2.0 if begin_rad > 0 else 2.0},
            "speed": 0.05,
        }
        action = guest.post(f"/devices/{device}/actions", {"request": request, "wait_ms": 10_000})["id"]
        wait_until(lambda: abs(target_rad(trace) - begin_rad) > 0.01, "motion")
        account = guest.get("/accounts/me")["id"]
        answer = owner.http.delete(f"/devices/{device}/shares/{account}")
        assert answer.status_code == httpx.codes.NO_CONTENT
        wait_until(lambda: at_rest(trace), "rest")
        ended = owner.get(f"/actions/{action}", wait_ms=20_000, wait_for="done")
        # The cloud or the device may report the end first.
        assert (ended["status"], ended["reason"]["code"]) in {("failed", "unshared"), ("failed", "lease_lost")}
        gone = guest.http.post(f"/devices/{device}/actions", json={"request": request})
        assert gone.status_code == httpx.codes.NOT_FOUND
        still_rad = target_rad(trace)
        time.sleep(0.5)
        assert target_rad(trace) == still_rad
        taken = owner.post(f"/devices/{device}/lease", {"lease_ms": 10_000})
        assert taken["confirmed"] is True, "the owner can take control"
        owner.http.delete(f"/devices/{device}/lease", params={"epoch": taken["epoch"]})


def at_rest(trace: Trace) -> bool:
    first, *_, last = trace.rows(20)
    return bool(first["target"] == last["target"])
