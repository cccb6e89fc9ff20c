"""Random runs of the controller: limits hold, and nothing moves without authority."""

import math
import random
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise

import pytest

from device_agent.ports.driver import REST, Twist
from device_agent.ports.geometry import Clearance, Sweep
from device_agent.protocol import DriveTarget, JogTarget, JointTarget, Mode, Setpoint, StopLatch
from device_agent.runtime.authority.authority import Reservation  # noqa: TC001 (only in annotations)
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import BASE, PERIOD_S
from tests.harness.agent.controller_fixture import ControllerFixture, Wall

Target = JointTarget | JogTarget | DriveTarget

MAX_SPEED, MAX_ACCELERATION, BRAKING, RANGE = 3.0, 8.0, 20.0, 3.0
LIMITS = (BASE.max_linear_m_s, 0.0, BASE.max_angular_rad_s)
ACCELERATIONS = (BASE.max_linear_acceleration_m_s2, 0.0, BASE.max_angular_acceleration_rad_s2)
DECELERATIONS = (BASE.braking_linear_m_s2, 0.0, BASE.braking_angular_rad_s2)
"""Limits of the base for each part of its twist."""
WALL_RAD = 1.4
REST_WITHIN_S = 0.3
EVENTS = 120
CLIPPED = BRAKING * 0.04**2 / 8
"""A braking path is checked at knots 40 ms apart (``JointMotion.propose``); in between it bends by at most this."""
JERK_PERIODS = 20
"""Periods in which an acceleration ends after the room slows the device."""


class Board(Wall):
    """A wall, and a hand: the elbow moves its x, the shoulder its y."""

    frames = ("hand",)

    def rates(
        self, frame: str, twist: Sequence[float], position_rad: Sequence[float], *, tool: bool
    ) -> tuple[float, ...]:
        del frame, position_rad
        return (twist[1], -twist[0] if tool else twist[0])


class Post(Board):
    """A post that the arm can touch."""

    def clearance(self, position_rad: Sequence[float]) -> Clearance:
        shoulder, elbow = position_rad
        return Clearance(max(self.at_rad - elbow, abs(shoulder - 0.8) - 0.2), ("hand", "post"))

    def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:
        fine = [
            [a + (b - a) * part / 10 for a, b in zip(begin, end, strict=True)]
            for begin, end in pairwise(path_rad)
            for part in range(10)
        ]
        return super().sweep([*fine, path_rad[-1]])


class RandomRun:
    """One seeded run of a controller, checked in each period against requests and responses only."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)  # noqa: S311
        shape = self.random.random()
        self.shape = Board(WALL_RAD) if shape < 0.4 else Post(WALL_RAD) if shape < 0.8 else None
        self.controller = ControllerFixture(geometry=self.shape, base=BASE).controller
        self.now_s = 100.0
        self.epoch = self.sequence = self.burned = self.slowed_for = 0
        self.numbered, self.input, self.ended_input = self.random.random() < 0.7, 0, 0
        self.reservation: Reservation | None = None
        self.may_move_until_s = -1.0
        self.position, self.velocity, self.twist = [0.0, 0.0], [0.0, 0.0], REST
        self.elapsed_s, self.share = PERIOD_S, 1.0
        self.authorized_s = self.rest_from_s = self.unauthorized_s = 0.0
        self.restrictions: dict[str, float] = {}

    def run(self) -> None:
        actions: dict[Callable[[], None], float] = {
            self.grant: 3,
            self.setpoint: 3,
            self.act: 3,
            self.move: 8,
            self.drive: 1,
            self.end: 1,
            self.stop: 0.4,
            self.reset: 2,
            self.lose_link: 0.4,
            self.fail: 0.3,
            self.restrict: 0.7,
            self.lift: 1.5,
            self.release: 0.5,
        }
        for _ in range(EVENTS):
            with suppress(Refused):
                self.random.choices(list(actions), list(actions.values()))[0]()
            for _ in range(self.random.choice((1, 2, 20, 50, 150))):
                self.tick()

    # ------------------------------------------------------------ requests

    def grant(self) -> None:
        self.epoch += self.random.choice((0, 1, 1))
        epoch, lease_s = self.epoch, self.random.uniform(0.05, 20.0)
        self.controller.grant(epoch=epoch, holder="ann", lease_s=lease_s, now_s=self.now_s)
        self.sequence = 0

    def clear_obstacles(self) -> bool:
        """Usually clear all restrictions first."""
        if self.random.random() < 0.2:
            return False
        if self.controller.latch is not None:
            self.reset()
        for source in list(self.restrictions):
            if self.restrictions[source] <= 0:
                self.controller.lift(source)
                del self.restrictions[source]
        self.epoch = max(self.epoch, *self.controller.epochs) + 1
        return True

    def setpoint(self) -> None:
        if self.reservation is None and self.random.random() < 0.7 and self.clear_obstacles():
            self.grant()
        self.input += self.numbered and self.random.random() < 0.6
        target = self.target()
        for _ in range(self.random.choice((1, 5, 20, 60, 120))):
            self.sequence += 1
            tick_ms = round(self.now_s * 1000)
            setpoint = Setpoint(
                epoch=self.epoch,
                sequence=self.sequence,
                echo_tick_ms=tick_ms - self.random.randint(0, 210),
                sent_ms=0.0,
                input=self.input,
                target=target() if callable(target) else target,
            )
            self.controller.accept_setpoint(setpoint, now_s=self.now_s, tick_ms=tick_ms)
            assert self.epoch > self.burned, "accepted although the lease has ended"
            assert not self.input or self.input > self.ended_input, "accepted although the input has ended"
            assert self.speed() > 0, "accepted although the room holds the device"
            self.may_move_until_s = self.now_s + REST_WITHIN_S
            self.rest_from_s = self.now_s + REST_WITHIN_S
            for _ in range(3):
                self.tick()

    def target(self) -> Target | Callable[[], Target]:
        """A target, also beyond the limits; sometimes a function that returns a random one at each call."""
        push = partial(self.random.uniform, -6, 6)
        elbow = push()
        kinds: list[Callable[[], Target]] = [
            lambda: JointTarget(position_rad={"elbow": elbow, "shoulder": self.random.choice((0.0, 1.5))}),
            lambda: DriveTarget(forward_m_s=push(), left_m_s=push(), turn_rad_s=push()),
        ]
        if self.shape is not None:
            kinds.append(lambda: JogTarget(linear_m_s=(push(), push(), 0.0), tool=self.random.random() < 0.5))

        def choose() -> Target:
            return self.random.choice(kinds)()

        return choose if self.random.random() < 0.2 else choose()

    def act(self) -> None:
        if self.reservation is None and not self.clear_obstacles():
            self.epoch += self.random.choice((0, 1))
        self.reservation = self.controller.reserve(epoch=self.epoch, on_revoked=self.on_revoked)
        assert self.epoch > self.burned, "accepted although the lease has ended"
        assert self.speed() > 0, "accepted although the room holds the device"

    def on_revoked(self, _why: Refused) -> None:
        self.reservation = None

    def move(self) -> None:
        if self.reservation is None:
            self.act()
        if self.reservation is not None:
            target = {"elbow": self.random.uniform(-3, 3), "shoulder": self.random.uniform(-1, 2)}
            self.controller.start_joint_goal(self.reservation, target, speed=self.random.uniform(0.05, 1.0))

    def drive(self) -> None:
        if self.reservation is not None:
            twist = Twist(self.random.uniform(-0.5, 0.5), 0.0, self.random.uniform(-1, 1))
            self.controller.start_drive(self.reservation, twist, duration_s=self.random.uniform(0.05, 3))

    def end(self) -> None:
        if self.reservation is not None:
            self.controller.end_reservation(self.reservation)
            self.reservation = None

    def stop(self) -> None:
        self.controller.stop(StopLatch(caller="bob", reason="", at_ms=1))
        self.check_revoked()
        if self.random.random() < 0.7:
            self.tick(self.random.uniform(0.02, 1.0) * PERIOD_S)

    def reset(self) -> None:
        self.epoch += 1
        self.controller.reset_stop(epoch=self.epoch)
        self.check_revoked()

    def lose_link(self) -> None:
        self.controller.interrupt(Refused("link_lost", "the link was lost"))

    def fail(self) -> None:
        self.controller.set_fault("no answer")
        self.check_revoked()
        for _ in range(30):
            self.tick()
        self.controller.clear_fault(self.position)

    def restrict(self) -> None:
        speed, source = self.random.choice((0.0, 0.2, 0.7, 0.7, math.nan)), self.random.choice("ab")
        moved = self.controller.moving or self.reservation is not None
        self.controller.restrict(source, speed, "a person is near")
        self.restrictions[source] = speed if speed > 0 else 0.0
        if self.speed() <= 0:
            assert self.reservation is None, "the action was not revoked"
            self.may_move_until_s = -1.0
            assert not moved or self.controller.epochs[0] == self.controller.epochs[1]

    def lift(self) -> None:
        source = self.random.choice("ab")
        self.controller.lift(source)
        self.restrictions.pop(source, None)

    def speed(self) -> float:
        return min(self.restrictions.values(), default=1.0)

    def release(self) -> None:
        self.controller.release(epoch=self.epoch)
        self.check_revoked()

    def check_revoked(self) -> None:
        assert self.reservation is None, "the action was not revoked"
        self.may_move_until_s = -1.0
        self.burned = max(self.burned, self.controller.epochs[0])
        assert self.controller.epochs[1] == self.controller.epochs[0]

    # ------------------------------------------------------------ checks

    def tick(self, elapsed_s: float = PERIOD_S) -> None:
        self.now_s += elapsed_s
        output = self.controller.update(self.now_s, elapsed_s=None if elapsed_s == PERIOD_S else elapsed_s)
        self.ended_input = output.ended_input
        between_s, self.elapsed_s = (self.elapsed_s + elapsed_s) / 2, elapsed_s
        faster = False
        self.slowed_for = self.slowed_for + 1 if self.speed() == self.share else 0
        self.share = self.speed()
        for index, (was, now) in enumerate(zip(self.position, output.position_rad, strict=True)):
            velocity = (now - was) / elapsed_s
            gain = abs(velocity) - abs(self.velocity[index])
            turned = velocity * self.velocity[index] < 0
            assert -RANGE - 1e-9 <= now <= RANGE + 1e-9
            assert abs(velocity) <= MAX_SPEED + 1e-6
            limit = MAX_ACCELERATION if gain > 0 and not turned else BRAKING
            assert abs(velocity - self.velocity[index]) / between_s <= limit + 1e-3
            faster |= gain > 1e-6
            if gain > 1e-6 and self.slowed_for > JERK_PERIODS:
                assert abs(velocity) <= self.speed() * MAX_SPEED + 1e-6, "faster than the room allows"
            self.velocity[index] = velocity
        self.position = output.position_rad
        if self.shape is not None:
            assert self.shape.clearance(self.position).excess_m >= -CLIPPED
        faster |= self.check_base(output.twist, elapsed_s)
        allowed = self.reservation is not None or self.now_s <= self.may_move_until_s + 1e-9
        authorized = allowed and output.mode in {Mode.STREAMING, Mode.ACTION}
        # Acceleration continues for four milliseconds after the start of a hold: the brakes have a ramp.
        self.unauthorized_s = 0.0 if authorized else self.unauthorized_s + elapsed_s
        assert self.unauthorized_s <= 2 * PERIOD_S + 1e-9 or not faster, "motion without authority"
        moving = max(map(abs, self.velocity)) > 1e-6 or any(abs(part) > 1e-6 for part in output.twist)
        if authorized:
            self.authorized_s = self.now_s
        if self.reservation is not None:
            self.rest_from_s = self.now_s + REST_WITHIN_S
        assert not moving or self.now_s <= self.rest_from_s + PERIOD_S, "zero 300 ms after the last setpoint"
        if self.now_s - self.authorized_s > 0.2:
            assert not moving, "a hold is complete within 200 ms"
        if self.reservation is None and self.now_s > self.may_move_until_s + PERIOD_S and output.mode is Mode.STREAMING:
            pytest.fail("setpoints apply no longer than 300 ms")

    def check_base(self, twist: Twist, elapsed_s: float) -> bool:
        """Check the base; returns whether any part of its twist grows."""
        faster = False
        for was, now, limit, acceleration, deceleration in zip(
            self.twist, twist, LIMITS, ACCELERATIONS, DECELERATIONS, strict=True
        ):
            gain = abs(now) - abs(was)
            assert abs(now) <= limit + 1e-6
            assert abs(now - was) / elapsed_s <= (acceleration if gain > 0 and now * was >= 0 else deceleration) + 1e-3
            faster |= gain > 1e-6
            if gain > 1e-6 and self.slowed_for > JERK_PERIODS:
                assert abs(now) <= self.speed() * limit + 1e-6, "faster than the room allows"
        self.twist = twist
        return faster


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_random_runs_respect_limits_and_authority(seed: int) -> None:
    RandomRun(seed).run()


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_many_random_runs_respect_limits_and_authority() -> None:
    for seed in range(1000, 3000):
        RandomRun(seed).run()
