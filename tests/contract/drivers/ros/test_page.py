"""The configurations of ``docs/robots/ros.md`` are accepted by the agent and by the driver."""

import tomllib

import msgspec
import pytest

from device_agent import drivers
from device_agent.config.agent_config import AgentConfig
from device_agent.drivers.ros.options import Options
from device_agent.protocol.manifests import robot_type as robot_types
from tests.harness.documents import block
from tests.harness.paths import ROBOTS, ROOT

PAGE = ROOT / "docs" / "robots" / "ros.md"


@pytest.mark.parametrize("name", ["arm", "base"])
def test_the_configuration_creates_a_driver(name: str) -> None:
    text = 'server = "https://telescope.example"\nname = "agent"\n' + block(PAGE, "file", f"~/{name}.toml")
    (device,) = msgspec.convert(tomllib.loads(text), AgentConfig).devices
    folder = ROBOTS / device.type
    driver = drivers.load(device.driver)(robot_types.load(folder), folder, device.options, device.name)
    assert driver.simulated is False


def test_every_option_is_documented() -> None:
    page = PAGE.read_text()
    assert [name for name in Options.__struct_fields__ if f"`{name}`" not in page and f"`{name}." not in page] == []
