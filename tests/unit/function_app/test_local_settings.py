"""``local.settings.json`` works with Azurite and the broker of ``make up``."""

import json

from azure.data.tables import TableServiceClient
from azure.storage.blob import BlobServiceClient

from function_app import settings
from function_app.settings import AzureStore
from infra.local import settings as local
from tests.harness.paths import ROOT


def test_the_settings_select_azurite_and_the_started_broker() -> None:
    values = json.loads((ROOT / "local.settings.json").read_text())["Values"]
    read = settings.read(values)
    started = local.read({})
    assert isinstance(read.store, AzureStore)
    with TableServiceClient.from_connection_string(read.store.connection) as tables:
        assert tables.url == "http://127.0.0.1:10002/devstoreaccount1"
    with BlobServiceClient.from_connection_string(read.store.connection) as blobs:
        assert blobs.url.rstrip("/") == "http://127.0.0.1:10000/devstoreaccount1"
    assert values["AzureWebJobsStorage"] == "UseDevelopmentStorage=true"
    assert (read.mqtt_port, read.websocket_port) == (started.mqtt_port, started.websocket_port)
    assert read.home.name == ".telescope"
