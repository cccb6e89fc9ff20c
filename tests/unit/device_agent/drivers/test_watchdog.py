"""The watchdog of drivers brakes once after the last command, and tries again after an error."""

import threading

from device_agent.drivers.watchdog import CommandWatchdog
from device_agent.ports.driver import DriverError
from tests.harness.network.brokers import SILENCE_S, wait_until


class Brake:
    def __init__(self, errors: int = 0) -> None:
        self.calls = 0
        self.errors = errors

    def __call__(self) -> None:
        self.calls += 1
        if self.calls <= self.errors:
            raise DriverError("no answer")


def test_it_brakes_once_after_the_last_command_and_again_after_the_next() -> None:
    brake = Brake()
    watchdog = CommandWatchdog(brake, device="base", timeout_s=0.02)
    watchdog.start()
    stopped = threading.Event()
    assert not stopped.wait(SILENCE_S)
    assert brake.calls == 0, "nothing was commanded"
    for count in (1, 2):
        watchdog.feed()
        wait_until(lambda count=count: brake.calls == count, "the brake")  # type: ignore[misc]
        assert not stopped.wait(SILENCE_S)
        assert brake.calls == count
    watchdog.stop()
    watchdog.stop()
    watchdog.feed()
    assert not stopped.wait(SILENCE_S)
    assert brake.calls == 2


def test_it_brakes_again_after_an_error() -> None:
    brake = Brake(errors=2)
    watchdog = CommandWatchdog(brake, device="base", timeout_s=0.02)
    watchdog.start()
    watchdog.feed()
    wait_until(lambda: brake.calls == 3, "the brake")
    watchdog.stop()
