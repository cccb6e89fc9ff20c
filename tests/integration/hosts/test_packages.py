"""What is deployed is small, and enough: the functions answer with nothing but their package."""

import asyncio
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from function_app import settings
from function_app.adapters import factory
from infra.aws.__main__ import SERVICES
from infra.aws.__main__ import main as package_for_aws
from tests.harness.cloud.cloud import API
from tests.harness.hosts.aws import start_lambda
from tests.harness.hosts.azure import start_azure
from tests.harness.hosts.host import PATIENCE_S
from tests.harness.paths import ROOT
from tests.harness.stores.aws import REGION, start_moto, use_credentials
from tests.harness.stores.azure import start_azurite

MAX_BYTES = 60_000_000
NEVER = ("numpy", "pandas", "mujoco", "scipy", "uvicorn")
"""What belongs to other programs than the functions."""


@pytest.fixture(scope="module")
def for_azure(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What Azure's build installs."""
    folder = tmp_path_factory.mktemp("azure") / "package"
    # uv resolves and unpacks as pip does, in a tenth of the time.
    command = [sys.executable, "-m", "uv", "pip", "install", "--quiet", "--python", sys.executable]
    done = subprocess.run(
        [*command, "--target", str(folder), "-r", str(ROOT / "requirements.txt")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"requirements.txt cannot be installed: {done.stderr}"
    return folder


@pytest.fixture(scope="module")
def for_aws(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("aws") / "package"
    assert package_for_aws([str(folder)]) == 0
    return folder


def test_the_libraries_for_azure_take_at_most_60_mb(for_azure: Path) -> None:
    assert_small(for_azure)


def test_the_package_for_aws_takes_at_most_60_mb(for_aws: Path) -> None:
    assert_small(for_aws)
    assert {each.name for each in (for_aws / "botocore" / "data").iterdir() if each.is_dir()} == SERVICES


def test_on_what_azure_installs_the_functions_answer_and_reach_their_store(for_azure: Path, tmp_path: Path) -> None:
    with start_azurite() as connection:
        environment = {
            "TELESCOPE_HOME": str(tmp_path),
            "TELESCOPE_MQTT_PORT": "1",
            "TELESCOPE_STORE": "azure",
            "TELESCOPE_STORAGE_CONNECTION": connection,
        }
        with start_azure(environment, package=for_azure) as host:
            assert httpx.get(f"{host.url}{API}/health", timeout=PATIENCE_S).json()["tables"] == "ok"
            host.tick()
    assert list(tmp_path.glob("tables.sqlite*")) == []


@pytest.fixture
def moto(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    use_credentials(monkeypatch)
    with start_moto() as endpoint:
        yield endpoint


def test_the_package_for_aws_answers_and_reaches_its_store(for_aws: Path, moto: str, tmp_path: Path) -> None:
    environment = {
        "TELESCOPE_HOME": str(tmp_path),
        "TELESCOPE_MQTT_PORT": "1",
        "TELESCOPE_STORE": "aws",
        "TELESCOPE_AWS_REGION": REGION,
        "TELESCOPE_AWS_BUCKET": "packaged",
        "TELESCOPE_AWS_ENDPOINT": moto,
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": "testing",
    }
    asyncio.run(factory.prepare(settings.read(environment)))
    with start_lambda(environment, package=for_aws) as host:
        assert httpx.get(f"{host.url}{API}/health", timeout=PATIENCE_S).json()["tables"] == "ok"
        host.tick()
    assert list(tmp_path.glob("tables.sqlite*")) == []


def test_a_folder_that_is_not_empty_is_left_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").touch()
    assert package_for_aws([str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"telescope: {tmp_path} is not empty; choose a new folder\n"
    assert [each.name for each in tmp_path.iterdir()] == ["mine"]


def assert_small(package: Path) -> None:
    files = [each for each in package.rglob("*") if each.is_file() and each.suffix != ".pyc"]
    size = sum(each.stat().st_size for each in files)
    assert size <= MAX_BYTES, f"{size} bytes"
    assert [name for name in NEVER if (package / name).exists()] == []
