"""Tests for drivers of other packages: the driver contract, and a template for new drivers. Needs ``pytest``."""

import pytest

pytest.register_assert_rewrite(
    "device_agent.drivers.testing.contract_steps", "device_agent.drivers.testing.driver_contract"
)
