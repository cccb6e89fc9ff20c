"""Virtual time for pollers."""

import pytest

from device_agent.runtime.telemetry import camera_streamer, periodic_poller, stream_sampler
from device_agent.runtime.telemetry.camera_streamer import CameraStreamer
from device_agent.runtime.telemetry.stream_sampler import StreamSampler


class PollClock:
    """A monotonic clock that the waits of a poller advance."""

    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def run(self, streamer: CameraStreamer | StreamSampler, seconds: float) -> None:
        """Poll for some virtual time, in the caller's thread."""
        end_s = self.now_s + seconds

        def wait(timeout_s: float) -> bool:
            self.now_s += timeout_s
            return self.now_s > end_s

        streamer._stopping.wait = wait  # type: ignore[assignment, method-assign]
        streamer._run()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> PollClock:
    clock = PollClock()
    for module in (camera_streamer, periodic_poller, stream_sampler):
        monkeypatch.setattr(module, "time", clock)
    return clock
