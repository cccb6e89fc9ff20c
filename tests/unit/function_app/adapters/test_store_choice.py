"""Where tables and blobs are is a setting; what is not chosen is not even imported."""

import subprocess
import sys
from pathlib import Path

import pytest

from function_app import bootstrap, settings
from function_app.settings import AwsStore, AzureStore, Settings, SettingsError
from tests.harness.paths import ROOT

CONNECTION = "DefaultEndpointsProtocol=https;AccountName=a;AccountKey=c2VjcmV0;EndpointSuffix=core.windows.net"
AZURE = {"TELESCOPE_STORE": "azure", "TELESCOPE_STORAGE_CONNECTION": CONNECTION}
IDENTITY = {
    "TELESCOPE_STORE": "azure",
    "TELESCOPE_STORAGE_TABLES_URL": "https://a.table.core.windows.net",
    "TELESCOPE_STORAGE_BLOBS_URL": "https://a.blob.core.windows.net",
}
AWS = {"TELESCOPE_STORE": "aws", "TELESCOPE_AWS_REGION": "eu-west-1", "TELESCOPE_AWS_BUCKET": "a-bucket"}


def test_without_any_it_is_this_machine() -> None:
    assert settings.read({}).store is None
    assert settings.read({"TELESCOPE_STORE": "local"}).store is None


def test_a_storage_account_by_its_connection_string() -> None:
    assert settings.read(AZURE).store == AzureStore(connection=CONNECTION)
    named = {**AZURE, "TELESCOPE_STORAGE_PREFIX": "lab2", "TELESCOPE_STORAGE_CONTAINER": "lab-2"}
    assert settings.read(named).store == AzureStore(connection=CONNECTION, prefix="lab2", container="lab-2")


def test_a_storage_account_by_its_addresses() -> None:
    client_id = "11059fcc-5514-4800-b5f8-49808b9cfab6"
    assert settings.read({**IDENTITY, "TELESCOPE_STORAGE_IDENTITY": client_id}).store == AzureStore(
        tables_url="https://a.table.core.windows.net",
        blobs_url="https://a.blob.core.windows.net",
        identity=client_id,
    )


def test_a_table_and_a_bucket() -> None:
    assert settings.read(AWS).store == AwsStore(region="eu-west-1", bucket="a-bucket")
    lambda_s = {"TELESCOPE_STORE": "aws", "AWS_REGION": "us-gov-west-1", "TELESCOPE_AWS_BUCKET": "a-bucket"}
    assert settings.read(lambda_s).store == AwsStore(region="us-gov-west-1", bucket="a-bucket")
    emulated = {**AWS, "TELESCOPE_AWS_ENDPOINT": "http://127.0.0.1:5000", "TELESCOPE_AWS_TABLE": "lab_2"}
    assert settings.read(emulated).store == AwsStore(
        region="eu-west-1", bucket="a-bucket", table="lab_2", endpoint="http://127.0.0.1:5000"
    )


WRONG = [
    ({}, "TELESCOPE_STORE", "gcp"),
    ({}, "TELESCOPE_STORE", ""),
    ({}, "TELESCOPE_STORE", "azure"),
    (AZURE, "TELESCOPE_STORAGE_CONNECTION", ""),
    (AZURE, "TELESCOPE_STORAGE_CONNECTION", "c2VjcmV0"),
    (AZURE, "TELESCOPE_STORAGE_CONNECTION", ";"),
    (AZURE, "TELESCOPE_STORAGE_PREFIX", "1a"),
    (AZURE, "TELESCOPE_STORAGE_PREFIX", "a-b"),
    (AZURE, "TELESCOPE_STORAGE_PREFIX", "a" * 33),
    (AZURE, "TELESCOPE_STORAGE_CONTAINER", "A"),
    (AZURE, "TELESCOPE_STORAGE_CONTAINER", "a--b"),
    (IDENTITY, "TELESCOPE_STORAGE_TABLES_URL", ""),
    (IDENTITY, "TELESCOPE_STORAGE_BLOBS_URL", ""),
    (IDENTITY, "TELESCOPE_STORAGE_BLOBS_URL", "http://a.blob.core.windows.net"),
    (IDENTITY, "TELESCOPE_STORAGE_IDENTITY", "me"),
    (AWS, "TELESCOPE_AWS_REGION", ""),
    (AWS, "TELESCOPE_AWS_REGION", "Ireland"),
    (AWS, "TELESCOPE_AWS_BUCKET", ""),
    (AWS, "TELESCOPE_AWS_BUCKET", "A_b"),
    (AWS, "TELESCOPE_AWS_TABLE", "a/b"),
    (AWS, "TELESCOPE_AWS_ENDPOINT", ""),
    (AWS, "TELESCOPE_AWS_ENDPOINT", "127.0.0.1:5000"),
]


@pytest.mark.parametrize(("given", "name", "value"), WRONG, ids=lambda part: part if isinstance(part, str) else "")
def test_a_wrong_one_is_named_in_one_line(given: dict[str, str], name: str, value: str) -> None:
    with pytest.raises(SettingsError) as caught:
        settings.read({**given, name: value})
    text = str(caught.value)
    assert name in text
    assert "\n" not in text
    assert len(text) < 300
    assert "c2VjcmV0" not in text


def test_a_key_is_not_shown_with_the_settings() -> None:
    assert "c2VjcmV0" not in repr(settings.read(AZURE))


async def _build(tmp_path: Path, store: AzureStore | AwsStore) -> tuple[str, str]:
    functions = bootstrap.build(Settings(home=tmp_path, store=store))
    await functions.close()
    return type(functions.tables).__name__, type(functions.blobs).__name__


@pytest.mark.anyio
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_the_chosen_one_is_built_and_opens_nothing(tmp_path: Path) -> None:
    azure, aws = settings.read(AZURE).store, settings.read(AWS).store
    assert azure is not None
    assert aws is not None
    assert await _build(tmp_path, azure) == ("AzureTables", "AzureBlobs")
    assert await _build(tmp_path, aws) == ("DynamoTables", "S3Blobs")


_IMPORTED = """
import sys
from pathlib import Path
from function_app import bootstrap, settings
built = bootstrap.build(settings.read({given!r}))
sdks = {{"azure", "boto3", "botocore"}}
print(*sorted(name for name in sys.modules if name.split(".")[0] in sdks or ".adapters.a" in name))
"""


@pytest.mark.parametrize(
    ("given", "adapters"), [({}, ""), (AZURE, "azure"), (AWS, "aws")], ids=["local", "azure", "aws"]
)
def test_no_sdk_is_imported_before_it_is_needed(tmp_path: Path, given: dict[str, str], adapters: str) -> None:
    program = _IMPORTED.format(given={**given, "TELESCOPE_HOME": str(tmp_path)})
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    found = done.stdout.split()
    assert all(name.startswith(f"function_app.adapters.{adapters}") for name in found), found
    assert bool(found) == bool(adapters)
