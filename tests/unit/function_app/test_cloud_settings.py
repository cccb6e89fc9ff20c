"""Settings of stores, buses and brokers in the clouds."""

import pytest

from function_app import settings
from function_app.settings import AwsStore, AzureStore, EventGridBus, EventGridWebhook, IotBus, SettingsError

KEY = "c2VjcmV0"
CONNECTION = f"DefaultEndpointsProtocol=https;AccountName=a;AccountKey={KEY};EndpointSuffix=core.windows.net"
CLIENT_ID = "11059fcc-5514-4800-b5f8-49808b9cfab6"
TABLES_URL, BLOBS_URL = "https://a.table.core.windows.net", "https://a.blob.core.windows.net"
IOT_URL = "https://a1b2c3-ats.iot.eu-west-1.amazonaws.com"
GRID_HOST = "lab.westeurope-1.ts.eventgrid.azure.net"
AZURE = {"TELESCOPE_STORE": "azure", "TELESCOPE_STORAGE_CONNECTION": CONNECTION}
IDENTITY = {
    "TELESCOPE_STORE": "azure",
    "TELESCOPE_STORAGE_TABLES_URL": TABLES_URL,
    "TELESCOPE_STORAGE_BLOBS_URL": BLOBS_URL,
}
AWS = {"TELESCOPE_STORE": "aws", "TELESCOPE_AWS_REGION": "eu-west-1", "TELESCOPE_AWS_BUCKET": "a-bucket"}
IOT = {"TELESCOPE_BUS": "iot", "TELESCOPE_AWS_REGION": "eu-west-1", "TELESCOPE_IOT_ENDPOINT": IOT_URL}
GRID = {"TELESCOPE_BUS": "eventgrid", "TELESCOPE_EVENTGRID_ENDPOINT": f"https://{GRID_HOST}"}
GRID_BROKER = {
    **GRID,
    "TELESCOPE_BROKER": "eventgrid",
    "TELESCOPE_MQTT_HOST": GRID_HOST,
    "TELESCOPE_MQTT_PORT": "8883",
    "TELESCOPE_WEBSOCKET_URL": f"wss://{GRID_HOST}:443/mqtt",
    "TELESCOPE_EVENTGRID_TENANT": CLIENT_ID,
    "TELESCOPE_EVENTGRID_AUDIENCE": f"api://{CLIENT_ID}",
    "TELESCOPE_EVENTGRID_CALLER": CLIENT_ID,
}


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, None),
        ({"TELESCOPE_STORE": "local"}, None),
        (AZURE, AzureStore(connection=CONNECTION)),
        (
            {**AZURE, "TELESCOPE_STORAGE_PREFIX": "lab2", "TELESCOPE_STORAGE_CONTAINER": "lab-2"},
            AzureStore(connection=CONNECTION, prefix="lab2", container="lab-2"),
        ),
        (
            {**IDENTITY, "TELESCOPE_STORAGE_IDENTITY": CLIENT_ID},
            AzureStore(tables_url=TABLES_URL, blobs_url=BLOBS_URL, identity=CLIENT_ID),
        ),
        (AWS, AwsStore(region="eu-west-1", bucket="a-bucket")),
        (
            {"TELESCOPE_STORE": "aws", "AWS_REGION": "us-gov-west-1", "TELESCOPE_AWS_BUCKET": "a-bucket"},
            AwsStore(region="us-gov-west-1", bucket="a-bucket"),
        ),
        (
            {**AWS, "TELESCOPE_AWS_ENDPOINT": "http://127.0.0.1:5000", "TELESCOPE_AWS_TABLE": "lab_2"},
            AwsStore(region="eu-west-1", bucket="a-bucket", table="lab_2", endpoint="http://127.0.0.1:5000"),
        ),
    ],
)
def test_the_store(environment: dict[str, str], expected: AzureStore | AwsStore | None) -> None:
    store = settings.read(environment).store
    assert store == expected
    assert KEY not in repr(store)


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, None),
        ({"TELESCOPE_BUS": "mqtt"}, None),
        (IOT, IotBus(region="eu-west-1", endpoint=IOT_URL)),
        (GRID, EventGridBus(endpoint=f"https://{GRID_HOST}")),
        (
            {**GRID, "TELESCOPE_EVENTGRID_IDENTITY": CLIENT_ID},
            EventGridBus(endpoint=f"https://{GRID_HOST}", identity=CLIENT_ID),
        ),
        (
            GRID_BROKER,
            EventGridBus(
                endpoint=f"https://{GRID_HOST}",
                webhook=EventGridWebhook(tenant=CLIENT_ID, audience=f"api://{CLIENT_ID}", caller=CLIENT_ID),
            ),
        ),
    ],
)
def test_the_bus(environment: dict[str, str], expected: IotBus | EventGridBus | None) -> None:
    found = settings.read(environment)
    assert found.bus == expected
    assert found.broker == environment.get("TELESCOPE_BROKER", "amqtt")


def test_event_grid_as_the_broker_needs_its_addresses() -> None:
    for name in ("TELESCOPE_BUS", "TELESCOPE_MQTT_HOST", "TELESCOPE_MQTT_PORT", "TELESCOPE_WEBSOCKET_URL"):
        incomplete = {key: value for key, value in GRID_BROKER.items() if key != name}
        with pytest.raises(SettingsError, match=f"TELESCOPE_BROKER is eventgrid; set {name}"):
            settings.read(incomplete)


@pytest.mark.parametrize(
    ("environment", "name", "values"),
    [
        ({}, "TELESCOPE_STORE", ["gcp", "", "azure"]),
        (AZURE, "TELESCOPE_STORAGE_CONNECTION", ["", KEY, ";"]),
        (AZURE, "TELESCOPE_STORAGE_PREFIX", ["1a", "a-b", "a" * 33]),
        (AZURE, "TELESCOPE_STORAGE_CONTAINER", ["A", "a--b"]),
        (IDENTITY, "TELESCOPE_STORAGE_TABLES_URL", [""]),
        (IDENTITY, "TELESCOPE_STORAGE_BLOBS_URL", ["", "http://a.blob.core.windows.net"]),
        (IDENTITY, "TELESCOPE_STORAGE_IDENTITY", ["me"]),
        (AWS, "TELESCOPE_AWS_REGION", ["", "Ireland"]),
        (AWS, "TELESCOPE_AWS_BUCKET", ["", "A_b"]),
        (AWS, "TELESCOPE_AWS_TABLE", ["a/b"]),
        (AWS, "TELESCOPE_AWS_ENDPOINT", ["", "127.0.0.1:5000"]),
        ({}, "TELESCOPE_BUS", ["kafka", ""]),
        (IOT, "TELESCOPE_IOT_ENDPOINT", ["", IOT_URL.removeprefix("https://")]),
        (IOT, "TELESCOPE_AWS_REGION", ["Ireland"]),
        (GRID, "TELESCOPE_EVENTGRID_ENDPOINT", ["", f"http://{GRID_HOST}"]),
        (GRID, "TELESCOPE_EVENTGRID_IDENTITY", ["me"]),
        (GRID_BROKER, "TELESCOPE_EVENTGRID_TENANT", ["", "lab"]),
        (GRID_BROKER, "TELESCOPE_EVENTGRID_AUDIENCE", [""]),
        (GRID_BROKER, "TELESCOPE_EVENTGRID_CALLER", ["the namespace"]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_invalid_variable_is_named_in_one_line(environment: dict[str, str], name: str, values: list[str]) -> None:
    for value in values:
        with pytest.raises(SettingsError) as caught:
            settings.read({**environment, name: value})
        text = str(caught.value)
        assert name in text
        assert "\n" not in text
        assert len(text) < 300
        assert KEY not in text
