"""Deployed packages are small, and the functions work with only these."""

import asyncio
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from function_app import settings
from function_app.adapters import factory
from infra import function_package
from infra.aws.__main__ import SERVICES
from infra.aws.__main__ import main as package_for_aws
from infra.azure.package import main as package_for_azure
from infra.function_package import PYTHON
from tests.conftest import Emulators
from tests.harness.cloud.cloud import API
from tests.harness.hosts.aws import start_lambda
from tests.harness.hosts.azure import start_azure
from tests.harness.hosts.host import PATIENCE_S, Host, cloud_python, environment_of
from tests.harness.paths import ROOT
from tests.harness.stores.aws import use_credentials
from tests.harness.stores.emulators import StoreKind, empty_store

MAX_BYTES = 60_000_000
NEVER = ("numpy", "pandas", "mujoco", "scipy", "uvicorn")
"""Packages of other programs."""


ADMINISTRATION = """
import os, sys
from function_app.__main__ import main

for command in (["prepare"], ["sign-in-link"], ["api-key", "--name", "x"], ["audit", "verify"]):
    assert main(command) == 0, command
assert os.environ["PYTHONPATH"] in sys.modules["function_app"].__file__
"""


@pytest.fixture(scope="module")
def for_azure(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package for Azure, with the libraries that Azure's build installs, for Azure's Python."""
    folder = tmp_path_factory.mktemp("azure") / "package"
    assert package_for_azure([str(folder)]) == 0
    # uv is ten times as fast as pip and installs the same files.
    command = [sys.executable, "-m", "uv", "pip", "install", "--quiet", "--python", cloud_python("azure")]
    done = subprocess.run(
        [*command, "--target", str(folder), "-r", str(folder / "requirements.txt")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"requirements.txt cannot be installed: {done.stderr}"
    return folder


@pytest.fixture(scope="module")
def for_aws(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("aws") / "package"
    done = subprocess.run([cloud_python("aws"), "-m", "infra.aws", str(folder)], cwd=ROOT, check=False)
    assert done.returncode == 0
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
    with start_azure(
        environment("azure", emulators, tmp_path), package=for_azure, python=cloud_python("azure")
    ) as host:
        assert_works(host, tmp_path)


def test_the_package_for_aws_is_small_and_sufficient(
    for_aws: Path, emulators: Emulators, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_small(for_aws)
    assert {each.name for each in (for_aws / "botocore" / "data").iterdir() if each.is_dir()} == SERVICES
    use_credentials(monkeypatch)
    variables = environment("aws", emulators, tmp_path)
    asyncio.run(factory.prepare(settings.read(variables)))
    with start_lambda(variables, package=for_aws, python=cloud_python("aws")) as host:
        assert_works(host, tmp_path)


@pytest.mark.parametrize(("cloud", "python"), [(cloud, cloud_python(cloud)) for cloud in PYTHON])
def test_the_administration_commands_run_from_the_shipped_files_only(
    request: pytest.FixtureRequest, tmp_path: Path, cloud: str, python: str
) -> None:
    package = str(request.getfixturevalue(f"for_{cloud}"))
    variables = {"PYTHONPATH": package, "TELESCOPE_HOME": str(tmp_path / "home"), "TELESCOPE_MQTT_PORT": "1"}
    done = subprocess.run(
        [python, "-S", "-c", ADMINISTRATION],
        cwd=tmp_path,
        env=environment_of(variables),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "/#sign-in=" in done.stdout
    assert "\nOK " in done.stdout


def test_the_requirements_install_on_the_python_of_azure(tmp_path: Path) -> None:
    # pip, because uv ignores the upper limits of Python versions that packages declare.
    pip = [cloud_python("azure"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    options = ["--dry-run", "--no-deps", "--only-binary", ":all:", "--target", str(tmp_path)]
    requirements = ["-r", str(ROOT / "requirements.txt")]
    done = subprocess.run([*pip, *options, *requirements], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_azures_build_publishes_the_same_files_from_the_repository(tmp_path: Path) -> None:
    folder = tmp_path / "package"
    assert package_for_azure([str(folder)]) == 0
    packaged = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    listed = ["git", "ls-files", "-z", "--cached", "--others"]
    tracked, ignored = (
        set(subprocess.run([*listed, *more], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0"))
        for more in (["--exclude-standard"], ["--ignored", "--exclude-from=.funcignore"])
    )
    console = {name for name in packaged if name.startswith("web/dist/")}
    published = {name for name in tracked - ignored if (ROOT / name).is_file()}
    assert published | console == packaged
    assert "web/dist/index.html" not in ignored


@pytest.mark.parametrize("package", [package_for_azure, package_for_aws])
def test_a_package_without_the_console_is_not_built(
    package: Callable[[list[str]], int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(function_package.require_console, "__defaults__", (tmp_path,))
    assert package([str(tmp_path / "package")]) == 1
    assert capsys.readouterr().err == "telescope: the console is not built; run `make console` first\n"
    assert not (tmp_path / "package").exists()


def test_a_folder_that_is_not_empty_is_unchanged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").touch()
    assert package_for_aws([str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"telescope: {tmp_path} is not empty; choose a new folder\n"
    assert [each.name for each in tmp_path.iterdir()] == ["mine"]
