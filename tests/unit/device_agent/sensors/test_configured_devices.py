"""Room devices described in ``agent.toml``: the entries of the guide, conversions and mistakes."""

import math
import sys
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent import bootstrap, sensors
from device_agent.cli.doctor import devices
from device_agent.config.agent_config import DeviceEntry
from device_agent.config.errors import ConfigError
from device_agent.ports.sensor import SensorError
from device_agent.sensors import json_path
from device_agent.sensors.conversion import Conversion, ConversionError
from tests.harness.documents import Block, blocks
from tests.harness.paths import ROOT

GUIDE = [block for block in blocks(ROOT / "docs" / "guides" / "room-devices.md") if block.use == "file"]
DRIVERS = ("modbus", "serial", "tasmota", "zigbee2mqtt")


def entries(text: str) -> list[DeviceEntry]:
    return msgspec.convert(tomllib.loads(text)["devices"], list[DeviceEntry])


def entry(**changes: Any) -> DeviceEntry:
    (found,) = entries(next(block.text for block in GUIDE if block.argument == "serial.toml"))
    return msgspec.convert(msgspec.to_builtins(found) | changes, DeviceEntry)


@pytest.mark.parametrize("block", GUIDE, ids=lambda block: block.argument)
def test_doctor_accepts_the_devices_of_the_guide(block: Block, tmp_path: Path) -> None:
    for each in entries(block.text):
        (finding,) = devices.device(each, tmp_path)
        assert (finding.level, finding.message) == (
            "ok",
            f"{each.type}, driver '{each.driver}': real; not touched by this check",
        )


def test_the_guide_shows_each_driver() -> None:
    assert sorted({each.driver for block in GUIDE for each in entries(block.text)}) == list(DRIVERS)


@pytest.mark.parametrize("driver", ["modbus", "serial"])
def test_a_missing_library_is_named_with_its_command(monkeypatch: pytest.MonkeyPatch, driver: str) -> None:
    library = {"modbus": "pymodbus", "serial": "serial"}[driver]
    for name in list(sys.modules):
        if name.partition(".")[0] == library or name.startswith(f"device_agent.sensors.{driver}"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Hidden(library), *sys.meta_path])
    with pytest.raises(SensorError) as error:
        sensors.load(driver)
    assert f"sensor driver '{driver}' needs {library}" in str(error.value)
    assert f"run `pip install 'telescope-agent[{driver}]'`" in str(error.value)


class Hidden:
    """An import finder that hides one package."""

    def __init__(self, package: str) -> None:
        self._package = package

    def find_spec(self, name: str, *_: object) -> None:
        if name.partition(".")[0] == self._package:
            raise ModuleNotFoundError(f"No module named '{name}'", name=self._package)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"streams": [{"name": "load", "rate_hz": 1.0}]}, "'scale' has no option 'streams.load', which maps it"),
        (
            {"streams": [{"name": "lines", "rate_hz": 1.0}]},
            "option 'streams.weight' of 'scale': no such entry; it has: lines",
        ),
        (
            {"controls": [{"name": "tare", "label": "Tare", "lower": 0.0, "upper": 1.0}]},
            "'scale' has no option 'controls.tare', which maps it",
        ),
        ({"captures": ["image"]}, "has no cameras and captures; remove them"),
        ({"options": {"path": "/dev/x", "bauds": 1}}, "has no option 'bauds'; it has: path, baud"),
        ({"options": {"path": 1}}, "options of 'scale': Expected `str`"),
    ],
)
def test_mistakes_are_problems_of_the_device(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    wrong = entry(**changes)
    with pytest.raises(ConfigError) as error:
        bootstrap.create_room_device(wrong, {}, home=tmp_path)
    assert message in str(error.value)
    (finding,) = devices.device(wrong, tmp_path)
    assert (finding.level, message in finding.message) == ("problem", True)


@pytest.mark.parametrize(
    ("conversion", "raw", "value"),
    [
        (Conversion(scale=0.1, offset=-4.0), 250, 21.0),
        (Conversion(words={"ON": True, "low": 0.25}), "ON", True),
        (Conversion(words={"ON": True, "low": 0.25}), "low", 0.25),
        (Conversion(scale=2.0), True, True),
        (Conversion(lower=0.0, upper=10.0), 10, 10.0),
    ],
)
def test_raw_values_are_converted(conversion: Conversion, raw: object, value: float | bool) -> None:
    assert conversion.value(raw) == value
    assert type(conversion.value(raw)) is type(value)


@pytest.mark.parametrize(
    ("conversion", "raw", "message"),
    [
        (Conversion(), math.nan, "'nan', which is not a finite number"),
        (Conversion(), 10**400, "'1000"),
        (Conversion(scale=1e10), 1e300, "which is not a finite number"),
        (Conversion(), None, "'None', which is not a number"),
        (Conversion(), [1], "which is not a number"),
        (Conversion(), "21.5\x1b[0m" + "x" * 100, "'21.5?[0mxxxx"),
        (Conversion(lower=0.0), -1, "-1, outside of its limits 0 to …"),
        (Conversion(upper=10.0), 11, "11, outside of its limits … to 10"),
    ],
)
def test_unusable_raw_values_are_rejected(conversion: Conversion, raw: object, message: str) -> None:
    with pytest.raises(ConversionError) as error:
        conversion.value(raw)
    assert message in str(error.value)
    assert len(str(error.value)) < 120


def test_a_control_value_is_converted_back() -> None:
    conversion = Conversion(scale=0.1, offset=-4.0)
    assert conversion.raw(21.0) == pytest.approx(250)


@pytest.mark.parametrize(
    "options",
    [
        {"scale": 0.0},
        {"scale": math.inf},
        {"lower": math.nan},
        {"lower": 1.0, "upper": 1.0},
        {"words": {"x": math.nan}},
    ],
)
def test_wrong_conversions_are_rejected(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="must"):
        Conversion(**options)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("a.b", 1),
        ("list.1", "y"),
        ("list.2", json_path.MISSING),
        ("list.x", json_path.MISSING),
        ("list.²", json_path.MISSING),
        ("dotted.key.c", 2),
        ("a.b.c", json_path.MISSING),
        ("none", None),
    ],
)
def test_paths_in_documents(path: str, value: object) -> None:
    document = {"a": {"b": 1}, "list": ["x", "y"], "dotted.key": {"c": 2}, "none": None}
    assert json_path.find(document, path) == value


def test_a_list_of_paths_is_short() -> None:
    deep: Any = 1
    for _ in range(500):
        deep = {"\x07level": deep}
    assert len(json_path.listed(deep)) < 320
    assert len(json_path.listed({str(number): 1 for number in range(10_000)})) < 320
    assert json_path.listed({"a": {"b": 1}, "c": 2}) == "a.b, c"
