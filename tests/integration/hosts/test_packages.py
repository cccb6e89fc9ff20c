"""Deployed packages are small, and the functions work with only these."""

import asyncio
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from function_app import settings
from function_app.adapters import factory
from infra.aws.__main__ import SERVICES
from infra.aws.__main__ import main as package_for_aws
from tests.conftest import Emulators
from tests.harness.cloud.cloud import API
from tests.harness.hosts.aws import start_lambda
from tests.harness.hosts.azure import start_azure
from tests.harness.hosts.host import PATIENCE_S, Host
from tests.harness.paths import ROOT
from tests.harness.stores.aws import use_credentials
from tests.harness.stores.emulators import StoreKind, empty_store

MAX_BYTES = 60_000_000
NEVER = ("numpy", "pandas", "mujoco", "scipy", "uvicorn")
"""Packages of other programs."""


@pytest.fixture(scope="module")
def for_azure(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the libraries that Azure's build installs."""
    folder = tmp_path_factory.mktemp("azure") / "package"
    # uv is ten times as fast as pip and installs the same files.
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


def assert_small(package: Path) -> None:
    files = [each for each in package.rglob("*") if each.is_file() and each.suffix != ".pyc"]
    size = sum(each.stat().st_size for each in files)
    assert size <= MAX_BYTES, f"{size} bytes"
    assert [name for name in NEVER if (package / name).exists()] == []


def assert_works(host: Host, home: Path) -> None:
    """Assert that the functions use their cloud store and no local one."""
    assert httpx.get(f"{host.url}{API}/health", timeout=PATIENCE_S).json()["tables"] == "ok"
    host.tick()
    assert list(home.glob("tables.sqlite*")) == []


def environment(kind: StoreKind, emulators: Emulators, home: Path) -> dict[str, str]:
    store = empty_store(kind, emulators(kind))
    return {"TELESCOPE_HOME": str(home), "TELESCOPE_MQTT_PORT": "1", **store}


def test_the_libraries_for_azure_are_small_and_sufficient(
    for_azure: Path, emulators: Emulators, tmp_path: Path
) -> None:
    assert_small(for_azure)
    with start_azure(environment("azure", emulators, tmp_path), package=for_azure) as host:
        assert_works(host, tmp_path)


def test_the_package_for_aws_is_small_and_sufficient(
    for_aws: Path, emulators: Emulators, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_small(for_aws)
    assert {each.name for each in (for_aws / "botocore" / "data").iterdir() if each.is_dir()} == SERVICES
    use_credentials(monkeypatch)
    variables = environment("aws", emulators, tmp_path)
    asyncio.run(factory.prepare(settings.read(variables)))
    with start_lambda(variables, package=for_aws) as host:
        assert_works(host, tmp_path)


def test_a_folder_that_is_not_empty_is_unchanged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").touch()
    assert package_for_aws([str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"telescope: {tmp_path} is not empty; choose a new folder\n"
    assert [each.name for each in tmp_path.iterdir()] == ["mine"]
