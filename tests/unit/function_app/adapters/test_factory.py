"""The settings select adapters; nothing else is imported or opened."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.paths import ROOT
from tests.unit.function_app.test_cloud_settings import AWS, AZURE, GRID, GRID_BROKER, IOT

LOCAL = ("SqliteTables", "FileBlobs", "MqttCommandBus")
SDKS = {"azure", "boto3", "botocore", "requests"}
PROGRAM = """
import asyncio, sys
from function_app import bootstrap, settings
functions = bootstrap.build(settings.read({environment!r}))
print(*(type(each).__name__ for each in (functions.tables, functions.blobs, functions.bus)))
print(*sorted(name for name in sys.modules if name.split(".")[0] in {sdks} or ".adapters.a" in name))
asyncio.run(functions.close())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "adapters", "package"),
    [
        ({}, LOCAL, ""),
        (AZURE, ("AzureTables", "AzureBlobs", LOCAL[2]), "azure"),
        (AWS, ("DynamoTables", "S3Blobs", LOCAL[2]), "aws"),
        (IOT, (*LOCAL[:2], "IotCommandBus"), "aws"),
        (GRID, (*LOCAL[:2], "EventGridCommandBus"), "azure"),
        (GRID_BROKER, (*LOCAL[:2], "EventGridCommandBus"), "azure"),
    ],
    ids=["local", "azure", "aws", "iot", "eventgrid", "eventgrid as broker"],
)
def test_only_the_selected_adapters_are_imported_and_no_sdk_before_it_is_needed(
    tmp_path: Path, environment: dict[str, str], adapters: tuple[str, ...], package: str
) -> None:
    program = PROGRAM.format(environment={**environment, "TELESCOPE_HOME": str(tmp_path)}, sdks=SDKS)
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    built, imported = done.stdout.splitlines()
    assert tuple(built.split()) == adapters
    assert bool(imported) == bool(package)
    assert all(name.startswith(f"function_app.adapters.{package}") for name in imported.split()), imported
