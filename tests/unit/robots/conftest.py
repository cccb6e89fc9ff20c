"""Simulated time only: the drivers accept snapshots of any age."""

import math

import pytest

from device_agent.drivers.mujoco import driver


@pytest.fixture(autouse=True)
def _manual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "STALE_S", math.inf)
