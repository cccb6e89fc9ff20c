"""Manual time: sensors use no cached views, and rendering may be slow."""

import pytest

from device_agent.sensors.mujoco import cameras, shared_view
from device_agent.simulation import renderer


@pytest.fixture(autouse=True)
def _manual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_view, "OLDEST_S", -1.0)
    monkeypatch.setattr(cameras, "FRESH_S", -1.0)
    monkeypatch.setattr(renderer, "TIMEOUT_S", 60.0)
