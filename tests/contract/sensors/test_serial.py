"""The driver ``serial`` with a pseudo terminal."""

import re
from collections.abc import Iterator
from typing import Any

import pytest

from device_agent.ports.sensor import RoomDriver, SensorError
from device_agent.protocol.manifests.room import RoomDeviceManifest
from tests.contract.sensors.conftest import MakeDriver, connects, described, error_of, sample
from tests.contract.sensors.suite import RoomDriverContract
from tests.harness.network.brokers import wait_until
from tests.harness.robots.room_devices.serial_line import SerialLine

PATTERN = {
    "pattern": r"T=(?P<t>[-+\w.]+) H=(?P<h>\d+)%",
    "streams": {"air": {"temperature_c": {"field": "t"}, "humidity": {"field": "h", "scale": 0.01}}},
}
JSON = {
    "format": "json",
    "streams": {"air": {"temperature_c": {"field": "air.t"}, "humidity": {"field": "air.h", "scale": 0.01}}},
}
CSV = {
    "format": "csv",
    "separator": ";",
    "streams": {"air": {"temperature_c": {"field": 1}, "humidity": {"field": 2, "scale": 0.01}}},
}
LINES = {"pattern": b"T=21.5 H=40%\r\n", "json": b'{"air": {"t": 21.5, "h": 40}}\n', "csv": b"7;21.5;40\n"}
OPTIONS: dict[str, dict[str, Any]] = {"pattern": PATTERN, "json": JSON, "csv": CSV}


def entry_of(line: SerialLine, form: str = "pattern", **options: Any) -> RoomDeviceManifest:
    streams = [{"name": "air", "rate_hz": 1.0}, {"name": "lines", "rate_hz": 1.0}]
    return described("serial", {"path": line.path, **OPTIONS[form], **options}, streams=streams)


@pytest.fixture
def line() -> Iterator[SerialLine]:
    with SerialLine() as line:
        yield line


@pytest.fixture
def connected(line: SerialLine, make_driver: MakeDriver) -> RoomDriver:
    driver = make_driver(entry_of(line))
    driver.connect()
    line.write(b"H=4%\n")  # the rest of a line, from before the connection
    return driver


class TestSerial(RoomDriverContract):
    @pytest.fixture
    def entry(self, line: SerialLine) -> RoomDeviceManifest:
        return entry_of(line)

    @pytest.fixture
    def driver(self, entry: RoomDeviceManifest, make_driver: MakeDriver) -> RoomDriver:
        return make_driver(entry)


@pytest.mark.parametrize("form", OPTIONS)
def test_each_line_is_one_sample(line: SerialLine, make_driver: MakeDriver, form: str) -> None:
    driver = make_driver(entry_of(line, form))
    driver.connect()
    line.write(b"rest of a line\n" + LINES[form])
    assert sample(driver, "air") == {"temperature_c": 21.5, "humidity": 0.4}
    assert driver.read("air") == {}
    assert driver.read("lines") == {"received": 1.0, "malformed": 0.0, "overlong": 0.0}


def test_malformed_and_overlong_lines_are_counted(line: SerialLine, connected: RoomDriver) -> None:
    line.write(b"garbage\n\xff\x00\xfe\n\n" + b"x" * 100_000 + b"\nT=1.5 H=2%\n")
    assert sample(connected, "air") == {"temperature_c": 1.5, "humidity": 0.02}
    assert connected.read("lines") == {"received": 4.0, "malformed": 2.0, "overlong": 1.0}


def test_a_line_without_end_needs_bounded_memory(line: SerialLine, connected: RoomDriver) -> None:
    for _ in range(20):
        line.write(b"x" * 50_000)
    line.write(b"\nT=1.5 H=2%\n")
    assert sample(connected, "air")
    assert connected.read("lines")["overlong"] == 1.0


def test_only_malformed_lines_are_a_fault(line: SerialLine, connected: RoomDriver) -> None:
    line.write(b"\x07garbage\n" * 10)
    expected = "the last 10 lines of 'device' were not usable: '?garbage', which `pattern` does not match; check `baud`"
    wait_until(lambda: expected in error_of(lambda: connected.read("air")), "the fault")
    assert expected in error_of(connected.connect)
    line.write(LINES["pattern"])
    wait_until(lambda: connects(connected), "the end of the fault")


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e999", "error"])
def test_a_value_that_is_not_finite_is_a_fault_until_a_finite_one_arrives(
    line: SerialLine, connected: RoomDriver, text: str
) -> None:
    line.write(f"T={text} H=40%\n".encode())
    wait_until(lambda: error_of(lambda: connected.read("air")), "the fault")
    error = error_of(connected.connect)
    assert re.fullmatch(r"stream 'air' of 'device': temperature_c is '.*', which is not a (finite )?number.*", error)
    line.write(LINES["pattern"])
    wait_until(lambda: connects(connected), "the end of the fault")
    assert sample(connected, "air") == {"temperature_c": 21.5, "humidity": 0.4}


@pytest.mark.parametrize(("form", "text"), [("json", b'{"air": {"t": 1}}\n'), ("csv", b"1;2\n")])
def test_a_missing_field_is_a_fault(line: SerialLine, make_driver: MakeDriver, form: str, text: bytes) -> None:
    driver = make_driver(entry_of(line, form))
    driver.connect()
    line.write(b"\n" + text)
    wait_until(lambda: "humidity is missing: the line has" in error_of(lambda: driver.read("air")), "the fault")


def test_an_unplugged_sensor_is_a_fault_until_it_returns(make_driver: MakeDriver, tmp_path: Any) -> None:
    link = tmp_path / "port"
    first = SerialLine()
    link.symlink_to(first.path)
    first_entry = entry_of(first)
    driver = make_driver(described("serial", first_entry.options | {"path": str(link)}, streams=[AIR]))
    driver.connect()
    first.write(b"\nT=1.5 H=2%\n")
    assert sample(driver, "air")["temperature_c"] == 1.5
    first.unplug()
    wait_until(
        lambda: "does not respond; check that it is plugged in" in error_of(lambda: driver.read("air")), "a fault"
    )
    link.unlink()
    assert "cannot be opened; check that the sensor is plugged in" in error_of(driver.connect)
    with SerialLine() as second:
        link.symlink_to(second.path)
        driver.connect()
        second.write(b"\nT=2.5 H=2%\n")
        assert sample(driver, "air")["temperature_c"] == 2.5
        driver.close()


AIR = {"name": "air", "rate_hz": 1.0}


def test_a_port_that_another_program_uses_is_a_fault(line: SerialLine, make_driver: MakeDriver) -> None:
    make_driver(entry_of(line)).connect()
    assert "cannot be opened" in error_of(make_driver(entry_of(line)).connect)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pattern": ""}, "`pattern` is needed"),
        ({"pattern": r"(?P<x>\d+)"}, "`pattern` has no such group; it has: x"),
        ({"pattern": r"(?P<t>\d+) (?P<h>\d+"}, "`pattern` is not a regular expression"),
        ({"pattern": r"(?=T)(?P<t>\d+) (?P<h>\d+)"}, "`pattern` cannot be used from '(?=T)(?P<t'"),
        ({"format": "csv", "pattern": ""}, "must be the number of a column"),
        ({"path": ""}, "$.path"),
    ],
)
def test_wrong_options_are_named(
    line: SerialLine, make_driver: MakeDriver, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(SensorError) as error:
        make_driver(entry_of(line, **options))
    assert message in str(error.value)
