"""What publishes commands is a setting; what is not chosen is not even imported."""

import subprocess
import sys
from pathlib import Path

import pytest

from function_app import bootstrap, settings
from function_app.settings import EventGridBus, EventGridWebhook, IotBus, Settings, SettingsError
from tests.harness.paths import ROOT

IOT = {
    "TELESCOPE_BUS": "iot",
    "TELESCOPE_AWS_REGION": "eu-west-1",
    "TELESCOPE_IOT_ENDPOINT": "https://a1b2c3-ats.iot.eu-west-1.amazonaws.com",
}
GRID = {
    "TELESCOPE_BUS": "eventgrid",
    "TELESCOPE_EVENTGRID_ENDPOINT": "https://lab.westeurope-1.ts.eventgrid.azure.net",
}
CLIENT_ID = "11059fcc-5514-4800-b5f8-49808b9cfab6"
GRID_BROKER = {
    **GRID,
    "TELESCOPE_BROKER": "eventgrid",
    "TELESCOPE_MQTT_HOST": "lab.westeurope-1.ts.eventgrid.azure.net",
    "TELESCOPE_MQTT_PORT": "8883",
    "TELESCOPE_WEBSOCKET_URL": "wss://lab.westeurope-1.ts.eventgrid.azure.net:443/mqtt",
    "TELESCOPE_EVENTGRID_TENANT": CLIENT_ID,
    "TELESCOPE_EVENTGRID_AUDIENCE": f"api://{CLIENT_ID}",
    "TELESCOPE_EVENTGRID_CALLER": CLIENT_ID,
}


def test_without_any_it_is_a_connection_to_the_broker() -> None:
    assert settings.read({}).bus is None
    assert settings.read({"TELESCOPE_BUS": "mqtt"}).bus is None


def test_a_clouds_broker_by_its_address() -> None:
    assert settings.read(IOT).bus == IotBus(region="eu-west-1", endpoint=IOT["TELESCOPE_IOT_ENDPOINT"])
    endpoint = GRID["TELESCOPE_EVENTGRID_ENDPOINT"]
    assert settings.read(GRID).bus == EventGridBus(endpoint=endpoint)
    named = {**GRID, "TELESCOPE_EVENTGRID_IDENTITY": CLIENT_ID}
    assert settings.read(named).bus == EventGridBus(endpoint=endpoint, identity=CLIENT_ID)


@pytest.mark.parametrize(
    ("given", "name", "value"),
    [
        ({}, "TELESCOPE_BUS", "kafka"),
        ({}, "TELESCOPE_BUS", ""),
        (IOT, "TELESCOPE_IOT_ENDPOINT", ""),
        (IOT, "TELESCOPE_IOT_ENDPOINT", "a1b2c3-ats.iot.eu-west-1.amazonaws.com"),
        (IOT, "TELESCOPE_AWS_REGION", "Ireland"),
        (GRID, "TELESCOPE_EVENTGRID_ENDPOINT", ""),
        (GRID, "TELESCOPE_EVENTGRID_ENDPOINT", "http://lab.westeurope-1.ts.eventgrid.azure.net"),
        (GRID, "TELESCOPE_EVENTGRID_IDENTITY", "me"),
        (GRID_BROKER, "TELESCOPE_EVENTGRID_TENANT", ""),
        (GRID_BROKER, "TELESCOPE_EVENTGRID_TENANT", "lab"),
        (GRID_BROKER, "TELESCOPE_EVENTGRID_AUDIENCE", ""),
        (GRID_BROKER, "TELESCOPE_EVENTGRID_CALLER", "the namespace"),
    ],
)
def test_a_wrong_one_is_named(given: dict[str, str], name: str, value: str) -> None:
    with pytest.raises(SettingsError, match=rf"{name} is '.*'; it must be ") as caught:
        settings.read({**given, name: value})
    assert "\n" not in str(caught.value)


def test_a_namespace_that_is_the_broker_needs_to_be_told_all_of_it() -> None:
    found = settings.read(GRID_BROKER)
    webhook = EventGridWebhook(tenant=CLIENT_ID, audience=f"api://{CLIENT_ID}", caller=CLIENT_ID)
    assert (found.broker, found.bus) == (
        "eventgrid",
        EventGridBus(endpoint=GRID["TELESCOPE_EVENTGRID_ENDPOINT"], webhook=webhook),
    )
    for name in ("TELESCOPE_BUS", "TELESCOPE_MQTT_HOST", "TELESCOPE_MQTT_PORT", "TELESCOPE_WEBSOCKET_URL"):
        with pytest.raises(SettingsError, match=f"TELESCOPE_BROKER is eventgrid; set {name}"):
            settings.read({key: value for key, value in GRID_BROKER.items() if key != name})


@pytest.mark.anyio
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
@pytest.mark.parametrize(
    ("given", "kind"), [({}, "MqttCommandBus"), (IOT, "IotCommandBus"), (GRID, "EventGridCommandBus")]
)
async def test_the_chosen_one_is_built_and_opens_nothing(tmp_path: Path, given: dict[str, str], kind: str) -> None:
    functions = bootstrap.build(Settings(home=tmp_path, bus=settings.read(given).bus))
    assert type(functions.bus).__name__ == kind
    await functions.close()


_IMPORTED = """
import sys
from function_app import bootstrap, settings
built = bootstrap.build(settings.read({given!r}))
sdks = {{"azure", "boto3", "botocore", "requests"}}
print(*sorted(name for name in sys.modules if name.split(".")[0] in sdks or ".adapters.a" in name))
"""


@pytest.mark.parametrize(
    ("given", "adapters"),
    [(IOT, "aws"), (GRID, "azure"), (GRID_BROKER, "azure")],
    ids=["iot", "eventgrid", "eventgrid as broker"],
)
def test_no_sdk_is_imported_before_it_is_needed(tmp_path: Path, given: dict[str, str], adapters: str) -> None:
    program = _IMPORTED.format(given={**given, "TELESCOPE_HOME": str(tmp_path)})
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    found = done.stdout.split()
    assert found
    assert all(name.startswith(f"function_app.adapters.{adapters}") for name in found), found
