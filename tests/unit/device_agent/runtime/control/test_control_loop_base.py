"""Control loop of a mobile robot."""

import threading

import pytest

from device_agent.ports.driver import REST, DriverError, Twist
from device_agent.protocol import JointTelemetry
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.control_loop import ControlLoop
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult
from tests.fakes.drivers import BASE, FakeDriver, robot_type
from tests.harness.agent.controller_fixture import ignore_revocation

WITHIN_S = 60.0


class Cart(FakeDriver):
    """A toy that drives."""

    def __init__(self) -> None:
        super().__init__()
        self.twists: list[Twist] = []
        self.drove = threading.Event()

    def drive(self, twist: Twist) -> Twist:
        self.twists.append(twist)
        if twist.forward_m_s > 0:
            self.drove.set()
        return twist


class Sitting(Cart):
    """A toy that could drive, but sits."""

    def drive(self, twist: Twist) -> Twist:
        super().drive(twist)
        return REST


def ignore(_telemetry: JointTelemetry) -> None:
    pass


def unwatched(_now_s: float) -> None:
    pass


def test_the_driver_receives_twists_until_the_drive_ends() -> None:
    kind, cart = robot_type(BASE), Cart()
    controller = Controller(kind, LeaseGate())
    loop = ControlLoop(kind, cart, controller, name="cart", publish=ignore, check_interlocks=unwatched)
    loop.start()
    try:
        reservation = controller.reserve(epoch=1, on_revoked=ignore_revocation)
        drive = controller.start_drive(reservation, Twist(0.2), duration_s=0.3)
        assert cart.drove.wait(WITHIN_S)
        assert drive.finished.wait(WITHIN_S)
        assert drive.result is GoalResult.REACHED
    finally:
        loop.stop()
    assert 0 < max(twist.forward_m_s for twist in cart.twists) <= 0.2 + 1e-9
    assert cart.twists[-1] == pytest.approx(Twist(), abs=1e-6)


@pytest.mark.parametrize(("cart", "limited"), [(Cart(), ()), (Sitting(), ("base: driver",))])
def test_a_twist_that_the_driver_changed_is_reported(cart: Cart, limited: tuple[str, ...]) -> None:
    kind = robot_type(BASE)
    controller = Controller(kind, LeaseGate())
    loop = ControlLoop(kind, cart, controller, name="cart", publish=ignore, check_interlocks=unwatched)
    loop.start()
    try:
        reservation = controller.reserve(epoch=1, on_revoked=ignore_revocation)
        drive = controller.start_drive(reservation, Twist(0.2), duration_s=0.5)
        assert drive.finished.wait(WITHIN_S)
        assert drive.limited == limited
    finally:
        loop.stop()


def test_a_type_with_a_base_needs_a_mobile_driver() -> None:
    kind = robot_type(BASE)
    loop = ControlLoop(
        kind, FakeDriver(), Controller(kind, LeaseGate()), name="cart", publish=ignore, check_interlocks=unwatched
    )
    with pytest.raises(DriverError, match="'cart' has a base, but its driver cannot drive"):
        loop.start()
    loop.stop()
