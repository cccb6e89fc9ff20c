"""The harness of a fully capable fake robot."""

import pytest

from tests.harness.agent.device_harness import DeviceHarness
from tests.unit.device_agent.runtime.actions.robot_api_fixture import AbleDriver, Head, able_type
from tests.unit.device_agent.runtime.conftest import MakeDevice


@pytest.fixture
def harness(make_device: MakeDevice) -> DeviceHarness:
    return make_device(driver=AbleDriver(), kind=able_type(), geometry=Head())
