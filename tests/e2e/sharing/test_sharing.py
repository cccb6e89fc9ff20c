"""Access to a shared arm is revoked while a guest moves it: the real agent holds it at once."""

import httpx

from tests.harness.browser.product import Machine
from tests.harness.browser.steering import assert_at_rest, commanded_speed
from tests.harness.network.brokers import wait_until


def test_revoking_a_moving_guest_stops_the_arm(machine: Machine) -> None:
    trace = machine.trace()
    with machine.api() as owner, machine.api("guest") as guest:
        device = owner.device()["id"]
        made = owner.post(f"/devices/{device}/invitations", {"role": "operator"})
        guest.post("/invitations/redeem", {"secret": made["secret"]})
        assert guest.device()["role"] == "operator"
        target_rad = -2.0 if trace.now()["target"]["shoulder_pan"] > 0 else 2.0
        request = {"kind": "move_joints", "position_rad": {"shoulder_pan": target_rad}, "speed": 0.05}
        action = guest.post(f"/devices/{device}/actions", {"request": request, "wait_ms": 10_000})["id"]
        wait_until(lambda: commanded_speed(trace) > 0, "motion")
        account = guest.get("/accounts/me")["id"]
        answer = owner.http.delete(f"/devices/{device}/shares/{account}")
        assert answer.status_code == httpx.codes.NO_CONTENT
        wait_until(lambda: commanded_speed(trace) == 0, "rest")
        ended = owner.get(f"/actions/{action}", wait_ms=20_000, wait_for="done")
        # The cloud or the device may report the end first.
        assert (ended["status"], ended["reason"]["code"]) in {("failed", "unshared"), ("failed", "lease_lost")}
        rejected = guest.http.post(f"/devices/{device}/actions", json={"request": request})
        assert rejected.status_code == httpx.codes.NOT_FOUND
        assert_at_rest(trace)
        taken = owner.post(f"/devices/{device}/lease", {"lease_ms": 10_000})
        assert taken["confirmed"] is True, "the owner can take control"
        owner.http.delete(f"/devices/{device}/lease", params={"epoch": taken["epoch"]})
