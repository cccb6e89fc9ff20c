"""The permission to restart: motion is rejected exactly while it is in force, and it ends by itself."""

from device_agent.runtime.restart_permission import PERMISSION_S, SUSPENDED, RestartPermission


class Robots:
    """Devices that the test moves, and a clock that it sets."""

    def __init__(self) -> None:
        self.reason = ""
        self.suspended = ""
        self.now_s = 0.0
        self.permission = RestartPermission(self, clock_s=lambda: self.now_s)

    def suspend(self, why: str) -> str:
        if not self.reason:
            self.suspended = why
        return self.reason

    def resume(self) -> None:
        self.suspended = ""


def test_motion_is_rejected_until_the_permission_is_returned() -> None:
    robots = Robots()
    token, reason = robots.permission.request()
    assert (bool(token), reason, robots.suspended) == (True, "", SUSPENDED)
    assert not robots.permission.cancel("ä")
    assert robots.suspended
    assert robots.permission.cancel(token)
    assert not robots.suspended
    assert not robots.permission.cancel(token)


def test_a_moving_device_prevents_the_permission() -> None:
    robots = Robots()
    robots.reason = "arm: it moves"
    assert robots.permission.request() == ("", "arm: it moves")
    assert not robots.permission.confirm("")
    assert not robots.permission.confirmed


def test_the_permission_expires_and_cannot_be_used_afterwards() -> None:
    robots = Robots()
    token, _ = robots.permission.request()
    robots.now_s = PERMISSION_S - 0.1
    robots.permission.expire()
    assert robots.suspended
    robots.now_s = PERMISSION_S
    assert not robots.permission.confirm(token)
    assert not robots.suspended
    assert not robots.permission.confirmed


def test_after_the_confirmation_motion_stays_rejected_until_the_end() -> None:
    robots = Robots()
    token, _ = robots.permission.request()
    assert not robots.permission.confirm("other")
    assert robots.permission.confirm(token)
    robots.now_s = 2 * PERMISSION_S
    robots.permission.expire()
    assert robots.permission.confirm(token), "a repeated confirmation"
    assert not robots.permission.cancel(token)
    assert robots.permission.request() == ("", "the agent restarts already")
    assert robots.suspended
    assert robots.permission.confirmed


def test_a_new_request_replaces_the_permission() -> None:
    robots = Robots()
    lost, _ = robots.permission.request()
    token, _ = robots.permission.request()
    assert not robots.permission.confirm(lost)
    assert robots.permission.confirm(token)
