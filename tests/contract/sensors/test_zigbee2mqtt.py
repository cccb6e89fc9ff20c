"""The driver ``zigbee2mqtt`` with a real broker and simulated Zigbee2MQTT."""

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import pytest

from device_agent.ports.sensor import RoomDriver, SensorError
from device_agent.protocol.manifests.room import RoomDeviceManifest
from tests.contract.sensors.conftest import MakeDriver, connects, described, error_of, sample
from tests.contract.sensors.suite import RoomDriverContract
from tests.harness.network.brokers import wait_until
from tests.harness.robots.room_devices.house_broker import HouseBroker
from tests.harness.robots.room_devices.zigbee2mqtt import Zigbee2Mqtt

AIR = {"temperature_c": {"path": "temperature"}, "humidity": {"path": "humidity", "scale": 0.01}}
SETTINGS = [{"name": "settings", "rate_hz": 1.0}]


def thermometer(house: HouseBroker, **options: Any) -> RoomDeviceManifest:
    return described(
        "zigbee2mqtt",
        {"broker": house.options(), "device": "thermometer", "streams": {"air": AIR}, **options},
        streams=[{"name": "air", "rate_hz": 1.0}],
    )


def settable(house: HouseBroker, device: str, upper: float = 1.0, **properties: Any) -> RoomDeviceManifest:
    return described(
        "zigbee2mqtt",
        {"broker": house.options(), "device": device, "controls": properties, "timeout_s": 2.0},
        streams=SETTINGS,
        controls=[{"name": name, "label": name, "lower": 0.0, "upper": upper} for name in properties],
    )


@pytest.fixture
def bridge(house: HouseBroker) -> Iterator[Zigbee2Mqtt]:
    with Zigbee2Mqtt(house) as bridge:
        yield bridge


@pytest.fixture
def connected(bridge: Zigbee2Mqtt, house: HouseBroker, make_driver: MakeDriver) -> RoomDriver:  # noqa: ARG001 (it must run)
    driver = make_driver(thermometer(house))
    driver.connect()
    return driver


@pytest.mark.usefixtures("bridge")
class TestThermometer(RoomDriverContract):
    @pytest.fixture
    def entry(self, house: HouseBroker) -> RoomDeviceManifest:
        return thermometer(house)

    @pytest.fixture
    def driver(self, entry: RoomDeviceManifest, make_driver: MakeDriver) -> RoomDriver:
        return make_driver(entry)


@pytest.mark.usefixtures("bridge")
class TestBulb(RoomDriverContract):
    resolution = 0.5  # it is on or off

    @pytest.fixture
    def entry(self, house: HouseBroker) -> RoomDeviceManifest:
        return settable(house, "bulb", on={"property": "state"}, level={"property": "brightness", "scale": 1 / 254})

    @pytest.fixture
    def driver(self, entry: RoomDeviceManifest, make_driver: MakeDriver) -> RoomDriver:
        return make_driver(entry)


def test_each_message_is_one_sample(connected: RoomDriver, bridge: Zigbee2Mqtt) -> None:
    bridge.send("thermometer", temperature=23.25, humidity=40)
    assert sample(connected, "air") == {"temperature_c": 23.25, "humidity": 0.4}
    assert connected.read("air") == {}


def test_a_retained_message_is_no_sample(house: HouseBroker, bridge: Zigbee2Mqtt, make_driver: MakeDriver) -> None:
    bridge.send("thermometer", retain=True, temperature=70.0)
    driver = make_driver(thermometer(house))
    driver.connect()
    bridge.publish("thermometer", b"", retain=True)
    bridge.publish("thermometer/availability", {"state": "online"})
    wait_until(lambda: driver._available, "a message that follows the retained one")  # type: ignore[attr-defined]
    assert driver.read("air") == {}
    bridge.send("thermometer", temperature=20.0)
    assert sample(driver, "air")["temperature_c"] == 20.0


@pytest.mark.parametrize("form", ["iso", "epoch"])
def test_a_message_with_an_old_last_seen_is_no_sample(connected: RoomDriver, bridge: Zigbee2Mqtt, form: str) -> None:
    def last_seen(at_s: float) -> object:
        return datetime.fromtimestamp(at_s, UTC).isoformat() if form == "iso" else round(at_s * 1000)

    bridge.send("thermometer", temperature=70.0, last_seen=last_seen(time.time() - 3600))
    bridge.publish("thermometer/availability", {"state": "online"})
    wait_until(lambda: connected._available, "a message that follows the old one")  # type: ignore[attr-defined]
    assert connected.read("air") == {}
    bridge.send("thermometer", temperature=21.0, last_seen=last_seen(time.time()))
    assert sample(connected, "air")["temperature_c"] == 21.0


def test_a_last_seen_that_is_no_time_is_ignored(connected: RoomDriver, bridge: Zigbee2Mqtt) -> None:
    bridge.publish("thermometer", f'{{"temperature": 22.0, "humidity": 40, "last_seen": {"1" * 400}}}')
    assert sample(connected, "air")["temperature_c"] == 22.0


def test_plug_bulb_and_blind_confirm_the_applied_value(
    house: HouseBroker, bridge: Zigbee2Mqtt, make_driver: MakeDriver
) -> None:
    plug = make_driver(settable(house, "plug", on={"property": "state"}))
    plug.connect()
    assert plug.set("on", 1.0) == 1.0
    assert bridge.states["plug"]["state"] == "ON"
    assert plug.read("settings") == {"on": 1.0}
    blind = make_driver(settable(house, "blind", opening={"property": "position", "scale": 0.01}))
    blind.connect()
    assert blind.set("opening", 0.3) == pytest.approx(0.3)
    assert bridge.states["blind"]["position"] == 30
    blind.hold()  # type: ignore[attr-defined]
    assert ("blind/set", {"state": "STOP"}) in bridge.commands


def test_a_lost_cover_cannot_be_held_and_is_stopped_when_it_is_back(
    house: HouseBroker, bridge: Zigbee2Mqtt, make_driver: MakeDriver
) -> None:
    blind = make_driver(settable(house, "blind", opening={"property": "position", "scale": 0.01}))
    blind.connect()
    bridge.vanish()
    house.stop()
    wait_until(lambda: not connects(blind), "the loss")
    with pytest.raises(SensorError, match="broker"):
        blind.hold()  # type: ignore[attr-defined]
    house.start()
    bridge.connect()
    wait_until(lambda: connects(blind), "the return")
    blind.hold()  # type: ignore[attr-defined]
    wait_until(lambda: ("blind/set", {"state": "STOP"}) in bridge.commands, "the stop")


def test_stored_values_and_those_before_an_absence_are_no_settings(
    house: HouseBroker, bridge: Zigbee2Mqtt, make_driver: MakeDriver
) -> None:
    plug = make_driver(settable(house, "plug", on={"property": "state"}))
    plug.connect()
    wait_until(lambda: plug.read("settings") == {"on": 0.0}, "the present value")
    bridge.publish("plug/availability", {"state": "offline"})
    wait_until(lambda: not connects(plug), "the absence")
    bridge.publish("plug/availability", {"state": "online"})
    wait_until(lambda: connects(plug), "the return")
    assert plug.read("settings") == {}
    plug._answered = False  # type: ignore[attr-defined]
    bridge.publish("plug", {"state": "ON", "last_seen": "2020-01-01T00:00:00Z"})
    bridge.publish("plug", {"power": 4.0})
    wait_until(lambda: plug._answered, "a message that follows the stored one")  # type: ignore[attr-defined]
    assert plug.read("settings") == {}


def test_a_device_that_does_not_respond_is_an_error(
    house: HouseBroker, bridge: Zigbee2Mqtt, make_driver: MakeDriver
) -> None:
    blind = make_driver(settable(house, "blind", opening={"property": "position", "scale": 0.01}))
    blind.connect()
    bridge.deaf = True
    with pytest.raises(SensorError, match="has not confirmed 'opening' within 2 s: '30' was requested"):
        blind.set("opening", 0.3)
    with pytest.raises(SensorError, match="has not responded within 1 s after it was stopped"):
        blind.hold()  # type: ignore[attr-defined]


@pytest.mark.parametrize("offline", [{"state": "offline"}, "offline"])
def test_availability_offline_is_a_fault_until_the_device_returns(
    connected: RoomDriver, bridge: Zigbee2Mqtt, offline: Any
) -> None:
    bridge.publish("thermometer/availability", offline, retain=True)
    wait_until(lambda: "is off line: Zigbee device" in error_of(lambda: connected.read("air")), "the fault")
    assert "off line" in error_of(connected.connect)
    bridge.publish("thermometer/availability", {"state": "online"}, retain=True)
    wait_until(lambda: connects(connected), "the end of the fault")
    bridge.publish("thermometer/availability", b"", retain=True)


def test_the_end_of_zigbee2mqtt_is_a_fault_until_it_returns(connected: RoomDriver, bridge: Zigbee2Mqtt) -> None:
    bridge.vanish()
    wait_until(lambda: "Zigbee2MQTT is not running" in error_of(lambda: connected.read("air")), "the last will")
    bridge.connect()
    wait_until(lambda: connects(connected), "the return")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"temperature": None, "humidity": 40}, "stream 'air' of 'device': temperature_c is 'None'"),
        ({"temperature": "nan", "humidity": 40}, "temperature_c is 'nan', which is not a number"),
        ('{"temperature": 1e999}', "it is not JSON"),
        ("[1, 2]", "it is not a JSON object"),
        ("x" * 70_000, "because it has 70000 bytes"),
    ],
)
def test_an_unusable_measurement_is_a_fault_until_a_usable_one_arrives(
    connected: RoomDriver, bridge: Zigbee2Mqtt, content: Any, message: str
) -> None:
    bridge.publish("thermometer", content)
    wait_until(lambda: message in error_of(lambda: connected.read("air")), "the fault")
    assert message in error_of(connected.connect)
    bridge.send("thermometer")
    wait_until(lambda: connects(connected), "the end of the fault")


@pytest.mark.usefixtures("bridge")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"device": "cellar"}, "has no device 'cellar'; it has: Coordinator, thermometer, bulb"),
        (
            {"streams": {"air": {"pressure_pa": {"path": "pressure"}}}},
            "option 'streams.air.pressure_pa': Zigbee device 'thermometer' has no 'pressure'; it has: temperature",
        ),
        ({"base_topic": "zigbee"}, "'zigbee/bridge/state' is not online"),
    ],
)
def test_options_that_do_not_fit_the_device_are_named(
    house: HouseBroker, make_driver: MakeDriver, options: dict[str, Any], message: str
) -> None:
    driver = make_driver(thermometer(house, **options))
    wait_until(lambda: message in error_of(driver.connect), message)


@pytest.mark.usefixtures("bridge")
def test_a_property_that_cannot_be_set_is_named(house: HouseBroker, make_driver: MakeDriver) -> None:
    driver = make_driver(settable(house, "plug", power={"property": "power"}))
    expected = "option 'controls.power': Zigbee device 'plug' cannot set 'power'; it can set: state"
    wait_until(lambda: expected in error_of(driver.connect), expected)


def test_a_description_that_cannot_be_read_is_a_fault(connected: RoomDriver, bridge: Zigbee2Mqtt) -> None:
    bridge.publish("bridge/devices", b"nonsense", retain=True)
    wait_until(lambda: "'zigbee2mqtt/bridge/devices' cannot be read" in error_of(connected.connect), "the fault")
    bridge.describe()
    wait_until(lambda: connects(connected), "the end of the fault")
