"""Selects the tests that need a controller of Universal Robots: URSim, or a real arm."""

import os

import pytest


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect tests marked ``ursim`` unless URSIM_HOST names a controller."""
    if os.environ.get("URSIM_HOST"):
        return
    left_out = [item for item in items if item.get_closest_marker("ursim")]
    items[:] = [item for item in items if not item.get_closest_marker("ursim")]
    config.hook.pytest_deselected(items=left_out)
