"""The driver ``tasmota`` with a real broker and a simulated Tasmota device."""

import json
import re
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from device_agent.ports.sensor import RoomDriver, SensorError
from device_agent.protocol.manifests.room import RoomDeviceManifest
from tests.contract.sensors.conftest import MakeDriver, connects, described, error_of, sample
from tests.contract.sensors.suite import RoomDriverContract
from tests.harness.network.brokers import HOST, wait_until
from tests.harness.robots.room_devices.house_broker import PASSWORD, HouseBroker
from tests.harness.robots.room_devices.tasmota import Tasmota

AIR = {
    "temperature_c": {"path": "AM2301.Temperature", "lower": -40.0, "upper": 80.0},
    "humidity": {"path": "AM2301.Humidity", "scale": 0.01},
}
CONTROLS = [
    {"name": "relay", "label": "Relay", "lower": 0.0, "upper": 1.0},
    {"name": "level", "label": "Level", "lower": 0.0, "upper": 1.0},
    {"name": "opening", "label": "Blind", "lower": 0.0, "upper": 1.0},
]
COMMANDS = {
    "relay": {"command": "POWER1"},
    "level": {"command": "Dimmer", "scale": 0.01},
    "opening": {"command": "ShutterPosition1", "scale": 0.01},
}


def entry_of(house: HouseBroker, **options: Any) -> RoomDeviceManifest:
    return described(
        "tasmota",
        {"broker": house.options(), "topic": "plug", "streams": {"air": AIR}, "controls": COMMANDS, **options},
        streams=[{"name": "air", "rate_hz": 1.0}, {"name": "settings", "rate_hz": 1.0}],
        controls=CONTROLS,
    )


@pytest.fixture
def tasmota(house: HouseBroker) -> Iterator[Tasmota]:
    with Tasmota(house, "plug") as tasmota:
        yield tasmota


@pytest.fixture
def entry(house: HouseBroker) -> RoomDeviceManifest:
    return entry_of(house)


@pytest.fixture
def connected(tasmota: Tasmota, entry: RoomDeviceManifest, make_driver: MakeDriver) -> RoomDriver:  # noqa: ARG001 (it must run)
    driver = make_driver(entry)
    driver.connect()
    sample(driver, "air")  # the first one answers the request at the start
    return driver


@pytest.mark.usefixtures("tasmota")
class TestTasmota(RoomDriverContract):
    resolution = 0.5  # a relay is on or off

    @pytest.fixture
    def entry(self, house: HouseBroker) -> RoomDeviceManifest:
        return entry_of(house)

    @pytest.fixture
    def driver(self, entry: RoomDeviceManifest, make_driver: MakeDriver) -> RoomDriver:
        return make_driver(entry)


def test_each_message_is_one_sample(connected: RoomDriver, tasmota: Tasmota) -> None:
    tasmota.send_sensor(AM2301={"Temperature": 22.5, "Humidity": 50})
    assert sample(connected, "air") == {"temperature_c": 22.5, "humidity": 0.5}
    assert connected.read("air") == {}


def test_a_retained_message_is_no_sample(tasmota: Tasmota, entry: RoomDeviceManifest, make_driver: MakeDriver) -> None:
    tasmota.deaf = True  # it does not answer the request at the start
    tasmota.publish("tele", "SENSOR", {"AM2301": {"Temperature": 79.0, "Humidity": 1}}, retain=True)
    driver = make_driver(entry)
    driver.connect()
    tasmota.send_state()
    wait_until(lambda: driver.read("settings"), "a message that follows the retained one")
    assert driver.read("air") == {}
    tasmota.publish("tele", "SENSOR", b"", retain=True)
    tasmota.send_sensor()
    wait_until(lambda: driver.read("air"), "a new measurement")


def test_relay_dimmer_and_shutter_confirm_the_applied_value(connected: RoomDriver, tasmota: Tasmota) -> None:
    assert connected.set("relay", 1.0) == 1.0
    assert tasmota.state["POWER"] == "ON"
    assert connected.set("level", 0.334) == 0.33
    assert connected.set("opening", 0.6) == pytest.approx(0.6)
    assert tasmota.commands[-3:] == [("POWER1", "ON"), ("Dimmer", "33"), ("ShutterPosition1", "60")]
    wait_until(lambda: connected.read("settings").get("opening") == pytest.approx(0.6), "the position of the shutter")
    assert connected.read("settings") == pytest.approx({"relay": 1.0, "level": 0.33, "opening": 0.6})


def test_a_command_without_confirmation_fails(house: HouseBroker, tasmota: Tasmota, make_driver: MakeDriver) -> None:
    driver = make_driver(entry_of(house, timeout_s=0.3))
    driver.connect()
    tasmota.silent = True
    with pytest.raises(
        SensorError, match=r"has not confirmed 'relay' within 0.3 s: 'ON' was requested, and it reports"
    ):
        driver.set("relay", 1.0)


@pytest.mark.usefixtures("tasmota")
def test_a_dimmer_that_applies_another_value_is_not_confirmed(house: HouseBroker, make_driver: MakeDriver) -> None:
    driver = make_driver(entry_of(house, timeout_s=0.3, controls={**COMMANDS, "level": {"command": "Dimmer"}}))
    driver.connect()
    with pytest.raises(SensorError, match="'150' was requested, and it reports '100'"):
        driver.set("level", 150.0)


def test_a_moving_shutter_stops_at_hold(connected: RoomDriver, tasmota: Tasmota) -> None:
    tasmota.travelling = True
    connected.set("opening", 0.9)
    assert tasmota.shutter["Direction"] == 1
    connected.hold()  # type: ignore[attr-defined]
    assert tasmota.shutter["Direction"] == 0
    tasmota.travelling = False


def test_a_shutter_that_does_not_confirm_its_stop_is_an_error(connected: RoomDriver, tasmota: Tasmota) -> None:
    tasmota.travelling = True
    connected.set("opening", 0.9)
    tasmota.deaf = True
    with pytest.raises(SensorError, match="has not confirmed within 1 s that it has stopped"):
        connected.hold()  # type: ignore[attr-defined]


def test_a_shutter_that_has_not_reported_since_its_command_may_move(connected: RoomDriver, tasmota: Tasmota) -> None:
    connected.set("opening", 0.5)
    wait_until(lambda: connected._directions == {"opening": 0}, "its rest")  # type: ignore[attr-defined]
    tasmota.deaf = True
    connected.send("opening", 90)  # type: ignore[attr-defined]
    with pytest.raises(SensorError, match="has not confirmed within 1 s that it has stopped"):
        connected.hold()  # type: ignore[attr-defined]


def test_a_loss_that_has_ended_confirms_no_value(
    connected: RoomDriver, tasmota: Tasmota, monkeypatch: pytest.MonkeyPatch
) -> None:
    tasmota.deaf = True
    problems = iter(["", "off line", ""])
    monkeypatch.setattr(connected, "_problem", lambda _broker: next(problems))
    with pytest.raises(SensorError, match="has not confirmed 'relay'"):
        connected.set("relay", 1.0)


def test_values_before_an_absence_are_forgotten_and_requested_again(connected: RoomDriver, tasmota: Tasmota) -> None:
    connected.set("relay", 1.0)
    tasmota.publish("tele", "LWT", "Offline", retain=True)
    wait_until(lambda: not connects(connected), "the loss")
    tasmota.state["POWER"] = "OFF"  # a power cycle
    before = len(tasmota.commands)
    tasmota.deaf = True
    tasmota.publish("tele", "LWT", "Online", retain=True)
    wait_until(lambda: tasmota.commands[before:] == [("STATUS", "10"), ("STATUS", "11")], "the request")
    assert connected.read("settings") == {}
    tasmota.deaf = False
    tasmota.send_state()
    wait_until(lambda: connected.read("settings").get("relay") == 0.0, "the present value")


def test_a_broker_that_sends_with_qos_2_is_left(house: HouseBroker, make_driver: MakeDriver) -> None:
    """The library stores such messages until the broker releases them."""
    with socket.create_server((HOST, 0)) as server:
        port = server.getsockname()[1]
        driver = make_driver(entry_of(house, broker=house.options(port=port)))
        filters = len(driver.filters())  # type: ignore[attr-defined]

        def serve() -> None:
            client, _ = server.accept()
            with client:
                client.recv(4096)
                client.sendall(b"\x20\x02\x00\x00")
                packet_id = client.recv(4096)[2:4]
                client.sendall(bytes([0x90, 2 + filters, *packet_id]) + b"\x01" * filters)
                client.sendall(b"\x34\x06\x00\x01a\x00\x01x")
                while client.recv(4096):
                    pass

        with ThreadPoolExecutor() as pool:
            served = pool.submit(serve)
            wait_until(lambda: "sends with QoS 2" in error_of(driver.connect), "the end of the connection")
            served.result(20)


def test_the_last_will_is_a_fault_until_the_device_returns(connected: RoomDriver, tasmota: Tasmota) -> None:
    tasmota.send_sensor()
    tasmota.vanish()

    wait_until(lambda: "is off line" in error_of(lambda: connected.read("air")), "the last will")
    with pytest.raises(SensorError, match="off line"):
        connected.connect()
    with pytest.raises(SensorError, match="off line"):
        connected.set("relay", 1.0)
    tasmota.connect()
    wait_until(lambda: connects(connected), "the return of the device")
    tasmota.send_sensor(AM2301={"Temperature": 19.0, "Humidity": 50})
    wait_until(lambda: connected.read("air").get("temperature_c") == 19.0, "a measurement")


def test_an_unknown_topic_is_named(house: HouseBroker, make_driver: MakeDriver) -> None:
    driver = make_driver(entry_of(house, topic="nowhere"))
    with pytest.raises(SensorError, match="knows no Tasmota device with the topic 'nowhere'"):
        driver.connect()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"AM2301": {"Temperature": None, "Humidity": 50}}, "stream 'air' of 'device': temperature_c is 'None', which"),
        ({"AM2301": {"Temperature": "nan", "Humidity": 50}}, "temperature_c is 'nan', which is not a number"),
        ({"AM2301": {"Temperature": 1e308, "Humidity": 1e308}}, "temperature_c is 1e.308, outside of its limits"),
        ({"AM2301": {"Temperature": 20.0}}, "SENSOR has no 'AM2301.Humidity' for humidity; it has: AM2301.Temperature"),
        ('{"AM2301": {"Temperature": NaN}}', "stream 'air' of 'device': a message was rejected: it is not JSON"),
        (b"\xff\xfe", "it is not JSON"),
        ("[" * 50_000, "it is not JSON"),
        (json.dumps({"x": "y" * 70_000}), "a message was rejected, because it has 700"),
    ],
)
def test_an_unusable_measurement_is_a_fault_until_a_usable_one_arrives(
    connected: RoomDriver, tasmota: Tasmota, content: Any, message: str
) -> None:
    tasmota.publish("tele", "SENSOR", content)
    wait_until(lambda: re.search(message, error_of(lambda: connected.read("air"))), "the fault")
    with pytest.raises(SensorError):
        connected.connect()
    tasmota.send_sensor()
    wait_until(lambda: connects(connected), "the end of the fault")


def test_a_packet_above_the_limit_is_not_received(
    connected: RoomDriver, tasmota: Tasmota, caplog: pytest.LogCaptureFixture
) -> None:
    tasmota.publish("tele", "SENSOR", b"x" * (5 << 20))
    wait_until(lambda: "has sent a message of 52" in caplog.text, "the end of the connection")
    wait_until(lambda: connects(connected), "the next connection")


def test_a_restart_of_the_broker_is_a_fault_that_ends(
    tasmota: Tasmota, house: HouseBroker, connected: RoomDriver
) -> None:
    house.stop()
    wait_until(lambda: not connects(connected), "the fault")
    with pytest.raises(SensorError, match=r"broker 127\.0\.0\.1"):
        connected.read("air")
    house.start()
    tasmota.client.close()
    tasmota.connect()
    wait_until(lambda: connects(connected), "the next connection")
    tasmota.send_sensor(AM2301={"Temperature": 18.0, "Humidity": 50})
    wait_until(lambda: connected.read("air").get("temperature_c") == 18.0, "a measurement")


def test_a_wrong_password_is_named_without_its_text(
    house: HouseBroker, make_driver: MakeDriver, tmp_path: Any, caplog: pytest.LogCaptureFixture
) -> None:
    wrong = tmp_path / "wrong"
    wrong.write_text("mistaken-secret\n")
    wrong.chmod(0o600)
    driver = make_driver(entry_of(house, broker=house.options(password_file="wrong")))
    wait_until(lambda: "rejects the connection" in error_of(driver.connect), "the rejection")
    assert "mistaken-secret" not in caplog.text
    assert PASSWORD not in caplog.text


def test_a_password_that_others_can_read_is_not_used(
    house: HouseBroker, make_driver: MakeDriver, tmp_path: Any
) -> None:
    open_file = tmp_path / "open"
    open_file.write_text(PASSWORD)
    open_file.chmod(0o644)
    driver = make_driver(entry_of(house, broker=house.options(password_file="open")))
    wait_until(lambda: "chmod 600" in error_of(driver.connect), "the rejection")
