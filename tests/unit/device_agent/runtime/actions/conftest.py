"""The harness of a fully capable fake robot."""

import pytest

from tests.harness.agent.device_harness import DeviceHarness
from tests.unit.device_agent.runtime.actions.robot_api_fixture import CapableDriver, Head, capable_type
from tests.unit.device_agent.runtime.conftest import MakeDevice


@pytest.fixture
def harness(make_device: MakeDevice) -> DeviceHarness:
    return make_device(driver=CapableDriver(), kind=capable_type(), geometry=Head())
