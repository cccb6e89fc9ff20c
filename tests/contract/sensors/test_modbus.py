"""The driver ``modbus`` with pymodbus's server, over TCP and over a serial line."""

import contextlib
import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from pymodbus.constants import ExcCodes

from device_agent.ports.sensor import RoomDriver, SensorError
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.modbus import bus
from tests.contract.sensors.conftest import MakeDriver, connects, described, error_of
from tests.contract.sensors.suite import RoomDriverContract
from tests.harness.network.brokers import HOST, wait_until
from tests.harness.network.ports import free_port
from tests.harness.robots.room_devices.modbus import SIZE, ModbusPeer, words
from tests.harness.robots.room_devices.serial_line import SerialCable

CLIMATE = {
    "temperature_c": {"address": 0, "table": "input", "scale": 0.1},
    "energy_kwh": {"address": 1, "table": "input", "type": "uint32", "scale": 0.001},
    "power_w": {"address": 3, "table": "input", "type": "float32", "word_order": "little"},
    "open": {"address": 5, "table": "discrete"},
}
CONTROLS = {
    "target_c": {"address": 10, "scale": 0.1},
    "fan": {"address": 12, "type": "float32"},
    "pump": {"address": 7, "table": "coil"},
}
LIMITS = {"target_c": (-10.0, 30.0), "fan": (0.0, 100.0), "pump": (0.0, 1.0)}


def entry_of(place: dict[str, Any], *, settings: bool = True, **options: Any) -> RoomDeviceManifest:
    streams = options.pop("streams", {"climate": CLIMATE})
    controls = options.pop("controls", CONTROLS)
    names = [*streams, *(["settings"] if controls and settings else [])]
    return described(
        "modbus",
        {"timeout_s": 0.5, **place, "streams": streams, "controls": controls, **options},
        streams=[{"name": name, "rate_hz": 1.0} for name in names],
        controls=[
            {"name": name, "label": name, "lower": LIMITS[name][0], "upper": LIMITS[name][1]} for name in controls
        ],
    )


def tcp(peer: ModbusPeer) -> dict[str, Any]:
    return {"host": HOST, "port": peer.port}


@pytest.fixture(params=["tcp", "rtu"])
def peer(request: pytest.FixtureRequest) -> Iterator[ModbusPeer]:
    """A device over TCP, and over a serial line."""
    with contextlib.ExitStack() as stack:
        if request.param == "tcp":
            peer = stack.enter_context(ModbusPeer())
            peer.place = tcp(peer)
        else:
            cable = stack.enter_context(SerialCable())
            peer = stack.enter_context(ModbusPeer(path=cable.far.path))
            peer.place = {"path": cable.near.path}
        peer.put("input", 0, [214, *words("I", 1_234_567), *reversed(words("f", 99.5))])
        peer.put("discrete", 5, [1])
        yield peer


@pytest.fixture
def network_peer() -> Iterator[ModbusPeer]:
    with ModbusPeer() as peer:
        peer.put("input", 0, [214, *words("I", 1_234_567), *reversed(words("f", 99.5))])
        peer.place = tcp(peer)
        yield peer


class TestModbus(RoomDriverContract):
    resolution = 0.5  # a coil is on or off

    @pytest.fixture
    def entry(self, peer: ModbusPeer) -> RoomDeviceManifest:
        return entry_of(peer.place)

    @pytest.fixture
    def driver(self, entry: RoomDeviceManifest, make_driver: MakeDriver) -> RoomDriver:
        return make_driver(entry)


def test_adjacent_registers_are_read_together_and_converted(peer: ModbusPeer, make_driver: MakeDriver) -> None:
    driver = make_driver(entry_of(peer.place))
    driver.connect()
    peer.requests.clear()
    values = driver.read("climate")
    assert values == pytest.approx({"temperature_c": 21.4, "energy_kwh": 1234.567, "power_w": 99.5, "open": True})
    assert sorted(peer.requests) == [(2, 5, 1), (4, 0, 5)]


def test_a_negative_value_in_swapped_bytes(network_peer: ModbusPeer, make_driver: MakeDriver) -> None:
    network_peer.put("holding", 20, [int.from_bytes((-55).to_bytes(2, "little", signed=True), "big")])
    source = {"address": 20, "byte_order": "little", "scale": 0.1}
    driver = make_driver(entry_of(network_peer.place, streams={"cold": {"temperature_c": source}}, controls={}))
    driver.connect()
    assert driver.read("cold") == pytest.approx({"temperature_c": -5.5})


def test_a_control_is_written_and_read_again(peer: ModbusPeer, make_driver: MakeDriver) -> None:
    driver = make_driver(entry_of(peer.place))
    driver.connect()
    assert driver.set("target_c", 21.57) == pytest.approx(21.6)
    assert driver.set("fan", 33.5) == 33.5
    assert driver.set("pump", 1.0) == 1.0
    assert peer.tables["holding"][10] == 216
    assert peer.tables["coil"][7] == 1
    assert driver.read("settings") == pytest.approx({"target_c": 21.6, "fan": 33.5, "pump": 1.0})
    assert driver.set("target_c", -5.0) == pytest.approx(-5.0)
    assert peer.tables["holding"][10] == 65536 - 50


def test_a_device_that_keeps_its_value_is_an_error(network_peer: ModbusPeer, make_driver: MakeDriver) -> None:
    driver = make_driver(entry_of(network_peer.place))
    driver.connect()
    network_peer.ignore_writes = True
    for control in CONTROLS:
        with pytest.raises(
            SensorError, match=f"control '{control}' of 'device': .* was written to .*, but the device has 0"
        ):
            driver.set(control, 1.0)


def test_an_illegal_address_names_register_and_option(peer: ModbusPeer, make_driver: MakeDriver) -> None:
    streams = {"climate": {"a": {"address": SIZE - 1}, "b": {"address": SIZE}}}
    driver = make_driver(entry_of(peer.place, streams=streams, controls={}))
    assert error_of(driver.connect) == (
        f"'device' rejects to read holding register {SIZE}: exception 2, illegal data address; "
        "check 'streams.climate.b' in its options"
    )


def test_a_wrong_address_of_a_control_is_found_at_the_start(network_peer: ModbusPeer, make_driver: MakeDriver) -> None:
    entry = entry_of(network_peer.place, settings=False, controls={"pump": {"address": SIZE, "table": "coil"}})
    assert f"coil {SIZE}: exception 2, illegal data address; check 'controls.pump'" in error_of(
        make_driver(entry).connect
    )


@pytest.mark.parametrize(
    ("code", "name"),
    [
        (ExcCodes.ILLEGAL_FUNCTION, "exception 1, illegal function"),
        (ExcCodes.DEVICE_FAILURE, "exception 4, server device failure"),
        (ExcCodes.DEVICE_BUSY, "exception 6, server device busy"),
        (ExcCodes.GATEWAY_NO_RESPONSE, "exception 11, gateway target device failed to respond"),
    ],
)
def test_exceptions_are_faults_with_their_names(
    network_peer: ModbusPeer, make_driver: MakeDriver, code: ExcCodes, name: str
) -> None:
    driver = make_driver(entry_of(network_peer.place))
    driver.connect()
    network_peer.fault = code
    assert name in error_of(lambda: driver.read("climate"))
    assert name in error_of(lambda: driver.set("pump", 1.0))
    assert name in error_of(driver.connect)
    network_peer.fault = None
    assert connects(driver)


def test_a_device_without_response_is_a_fault_that_ends(peer: ModbusPeer, make_driver: MakeDriver) -> None:
    driver = make_driver(entry_of(peer.place))
    driver.connect()
    peer.silent = True
    assert "no valid response at" in error_of(lambda: driver.read("climate"))
    assert "no valid response at" in error_of(driver.connect)
    assert "no valid response at" in error_of(lambda: driver.set("pump", 1.0))
    peer.silent = False
    wait_until(lambda: connects(driver), "the device")
    assert driver.read("climate")["temperature_c"] == pytest.approx(21.4)


def test_a_closed_idle_connection_is_opened_again(make_driver: MakeDriver) -> None:
    with ModbusPeer() as peer:
        driver = make_driver(entry_of(tcp(peer)))
        driver.connect()
    with ModbusPeer(port=peer.port):
        assert driver.read("climate")["temperature_c"] == 0.0


def test_a_refused_connection_is_a_fault(make_driver: MakeDriver) -> None:
    port = free_port()
    driver = make_driver(entry_of({"host": HOST, "port": port}))
    assert error_of(driver.connect) == f"{HOST}:{port} cannot be opened; check `host`, `port` and the network"


def test_an_unplugged_line_is_a_fault_without_a_name_of_the_library(make_driver: MakeDriver) -> None:
    with SerialCable() as cable, ModbusPeer(path=cable.far.path):
        driver = make_driver(entry_of({"path": cable.near.path}))
        driver.connect()
        cable.unplug()
        assert f"{cable.near.path} cannot be opened; check that `path`" in error_of(lambda: driver.read("climate"))
        assert "cannot be opened" in error_of(driver.connect)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_a_value_that_is_not_finite_is_a_fault_of_its_quantity(
    network_peer: ModbusPeer, make_driver: MakeDriver, value: float
) -> None:
    driver = make_driver(entry_of(network_peer.place))
    driver.connect()
    network_peer.put("input", 3, list(reversed(words("f", value))))
    expected = f"option 'streams.climate.power_w' of 'device': power_w is '{value}', which is not a finite number"
    assert error_of(lambda: driver.read("climate")) == expected
    assert error_of(driver.connect) == expected


def test_a_value_outside_of_its_limits_is_a_fault(network_peer: ModbusPeer, make_driver: MakeDriver) -> None:
    source = {"address": 0, "table": "input", "scale": 0.1, "lower": -40.0, "upper": 80.0}
    network_peer.put("input", 0, [3000])
    driver = make_driver(entry_of(network_peer.place, streams={"air": {"temperature_c": source}}, controls={}))
    assert "temperature_c is 300, outside of its limits -40 to 80" in error_of(driver.connect)


def test_two_devices_share_one_line(make_driver: MakeDriver) -> None:
    with SerialCable() as cable, ModbusPeer(path=cable.far.path):
        place = {"path": cable.near.path}
        first, second = make_driver(entry_of(place)), make_driver(entry_of(place))
        first.connect()
        second.connect()
        first.close()
        assert second.read("climate")
        third = make_driver(entry_of({**place, "baud": 19200}))
        assert "with other settings of the line" in error_of(third.connect)
        second.close()
        assert not bus._buses


def test_a_value_that_does_not_fit_is_an_error(network_peer: ModbusPeer, make_driver: MakeDriver) -> None:
    driver = make_driver(entry_of(network_peer.place))
    driver.connect()
    with pytest.raises(SensorError, match="control 'target_c' of 'device': 40000 is not a value of int16"):
        driver.set("target_c", 4000.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "either `host` (Modbus TCP) or `path` (a serial line) is needed"),
        ({"host": "h", "path": "/dev/x"}, "either `host`"),
        ({"host": "h", "hots": 1}, "driver 'modbus' of 'device' has no option 'hots'; it has: host, port"),
        ({"host": "h", "controls": {"pump": {"address": 1, "table": "input"}}}, "`holding` or `coil`"),
        ({"host": "h", "streams": {"x": {"y": {"address": 65_535, "type": "int32"}}}}, "ends after address 65535"),
        ({"host": "h", "streams": {"x": {"y": {"address": 1, "scale": 0.0}}}}, "`scale` must not be 0"),
        ({"host": "h", "streams": {"x": {"y": {"address": 1, "lower": 2.0, "upper": 1.0}}}}, "`lower` must be below"),
        ({"host": "h", "streams": {"x": {}}}, "option 'streams.x' of 'device' maps no quantity"),
    ],
)
def test_wrong_options_are_named(make_driver: MakeDriver, options: dict[str, Any], message: str) -> None:
    with pytest.raises(SensorError) as error:
        make_driver(entry_of({}, **options))
    assert message in str(error.value)


@pytest.fixture
def hostile() -> Iterator[tuple[int, list[bytes]]]:
    """Port of a server that answers each request with the next of these byte strings, and then closes."""
    answers: list[bytes] = []
    with socket.create_server((HOST, 0)) as listener:

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    opened, _ = listener.accept()
                    with opened:
                        request = opened.recv(300)
                        opened.sendall(request[:2] + answers[0])

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield listener.getsockname()[1], answers
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()


@pytest.mark.parametrize(
    "answer",
    [
        b"\x00\x00\x00\x03\x01\x84\x7f",  # unknown exception code
        b"\x00\x00\x00\x05\x01\x04\x02\x00\x01",  # one register instead of five
        b"\x00\x00\x00\x04\x01\x04\xff\x00",  # length of the data is wrong
        b"\x00\x00\x00\x03\x01\x04\x00",  # no data
        b"\x00\x00\x00\x03\x01\x03\x02\x00\x01",  # another function
        b"\x00\x00\xff\xff\x01\x04" + b"x" * 1000,  # length of the frame is wrong
        b"\x00\x00\x00\x02\x01\x84",  # exception without code
        b"\x00\x00\x00\x00",
        b"\xff" * 400,
        b"",
    ],
    ids=lambda answer: answer[:10].hex(),
)
def test_a_malformed_response_is_a_fault(
    hostile: tuple[int, list[bytes]], make_driver: MakeDriver, answer: bytes
) -> None:
    port, answers = hostile
    answers.append(answer)
    driver = make_driver(entry_of({"host": HOST, "port": port, "timeout_s": 0.2}, controls={}))
    error = error_of(driver.connect)
    assert "no valid response" in error or "exception 127, unknown" in error or "has sent" in error, error
