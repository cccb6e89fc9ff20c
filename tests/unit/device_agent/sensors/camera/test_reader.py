"""Attempts of the reader after failures."""

from collections.abc import Callable, Iterator

import pytest

from device_agent.ports.sensor import Frame, SensorError
from device_agent.sensors.camera import reader as reader_module
from device_agent.sensors.camera.reader import CameraReader, RejectedError
from tests.harness.network.brokers import wait_until

StartReader = Callable[[type[SensorError]], "FailingSource"]


class FailingSource:
    """A camera that fails each time."""

    def __init__(self, error: type[SensorError]) -> None:
        self._error = error
        self.attempts = 0

    def frames(self) -> Iterator[Frame]:
        self.attempts += 1
        yield from self._fail()

    def _fail(self) -> tuple[Frame, ...]:
        raise self._error("it fails")

    def abort(self) -> None:
        pass


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[StartReader]:
    """Starts a reader whose usual pauses are short."""
    monkeypatch.setattr(reader_module, "_RETRY_S", (0.01, 0.01))
    readers: list[CameraReader] = []

    def started(error: type[SensorError]) -> FailingSource:
        source = FailingSource(error)
        readers.append(CameraReader(source, device="door", stale_s=5.0))
        readers[-1].start()
        return source

    yield started
    for reader in readers:
        reader.close()


def test_rejected_credentials_are_not_sent_again_soon(start: StartReader) -> None:
    """Cameras lock an account after several failures in a row."""
    rejecting = start(RejectedError)
    wait_until(lambda: rejecting.attempts, "the rejected attempt")
    failing = start(SensorError)
    wait_until(lambda: failing.attempts >= 20, "attempts after other failures")
    assert rejecting.attempts == 1
