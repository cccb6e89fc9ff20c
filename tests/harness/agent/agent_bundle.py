"""Offline bundles of releases for tests, and a service manager for an installed agent.

The wheel of the agent is built once. Further versions are copies with another version number, and changes that a test
chooses. Instead of its dependencies, a bundle contains a package that gives access to those of the tests.
"""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import threading
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from tests.harness.paths import ROOT

SCRIPT = ROOT / "device_agent/cli/releases/install-agent.sh"
_VERSION_FILE = "device_agent/config/release.py"
_ENVIRONMENT = "telescope_test_environment"


def build_wheel(folder: Path) -> Path:
    """Build the wheel of the agent, as ``make wheels`` does."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--no-build-isolation", "--wheel-dir", str(folder), str(ROOT / "infra/packaging/telescope-agent")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("telescope_agent-*.whl")
    return wheel


def bundle(folder: Path, wheel: Path, version: str, changes: Mapping[str, tuple[str, str]] | None = None) -> Path:
    """Write the bundle of a release; returns its folder.

    Args:
        folder: Parent folder.
        wheel: Built by ``build_wheel``.
        version: Version of the release.
        changes: File of the package → text to replace, and its replacement.
    """
    target = folder / f"bundle-{version}"
    wheels = target / "wheels"
    wheels.mkdir(parents=True)
    agent = _with_version(wheel, wheels, version, changes or {})
    environment = _environment(wheels)
    pins = [f"telescope-agent=={version} --hash=sha256:{_digest(agent)}"]
    pins.append(f"{_ENVIRONMENT}==1 --hash=sha256:{_digest(environment)}")
    (target / "requirements.txt").write_text("".join(f"{pin}\n" for pin in pins))
    number = f"{sys.version_info.major}.{sys.version_info.minor}"
    (target / "BUNDLE").write_text(f"version={version}\nmachine={platform.machine()}\npython={number}\ncompiles=\n")
    shutil.copy(SCRIPT, target)
    files = sorted(path for path in target.rglob("*") if path.is_file())
    (target / "SHA256SUMS").write_text("".join(f"{_digest(path)}  {path.relative_to(target)}\n" for path in files))
    return target


def _with_version(wheel: Path, folder: Path, version: str, changes: Mapping[str, tuple[str, str]]) -> Path:
    """Copy the wheel with another version, and with the UR5 as its only robot."""
    before = wheel.name.split("-")[1]
    changed = dict(changes) | {_VERSION_FILE: (f'VERSION = "{before}"', f'VERSION = "{version}"')}
    copy = folder / wheel.name.replace(before, version, 1)
    with zipfile.ZipFile(wheel) as source, zipfile.ZipFile(copy, "w") as target:
        for name in source.namelist():
            if name.startswith("device_agent/robots/") and not name.startswith("device_agent/robots/ur5/"):
                continue
            content = source.read(name)
            if name in changed:
                old, new = changed[name]
                assert old in content.decode(), f"{name} does not contain {old!r}"
                content = content.decode().replace(old, new, 1).encode()
            if ".dist-info/" in name:
                content = content.replace(f"Version: {before}\n".encode(), f"Version: {version}\n".encode())
            if name.endswith("/RECORD"):
                rows = content.decode().replace(f"-{before}.dist-info", f"-{version}.dist-info").splitlines()
                content = "".join(f"{row.split(',')[0]},,\n" for row in rows if "/robots/" not in row).encode()
            target.writestr(name.replace(f"-{before}.dist-info", f"-{version}.dist-info"), content)
    return copy


def _environment(folder: Path) -> Path:
    """A package with a ``.pth`` file that names the folder of this interpreter's packages."""
    file, info = folder / f"{_ENVIRONMENT}-1-py3-none-any.whl", f"{_ENVIRONMENT}-1.dist-info"
    contents = {
        f"{_ENVIRONMENT}.pth": sysconfig.get_path("purelib") + "\n",
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {_ENVIRONMENT}\nVersion: 1\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    with zipfile.ZipFile(file, "w") as wheel:
        for name, text in contents.items():
            wheel.writestr(zipfile.ZipInfo(name), text)
        record = "".join(f"{name},,\n" for name in (*contents, f"{info}/RECORD"))
        wheel.writestr(zipfile.ZipInfo(f"{info}/RECORD"), record)
    return file


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


class InstalledAgent:
    """An agent that ``install-agent.sh`` installed. As a context manager, it runs as under a service manager.

    Attributes:
        starts: Number of starts of the launcher.
    """

    def __init__(self, folder: Path) -> None:
        self.prefix, self.home = folder / "prefix", folder / "home"
        self.program = self.prefix / "bin/telescope-agent"
        self.log = folder / "log"
        self.starts = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._process: subprocess.Popen[bytes] | None = None

    def install(self, *options: str) -> "subprocess.CompletedProcess[str]":
        """Run the install script."""
        command = ["sh", str(SCRIPT), "--prefix", str(self.prefix), "--python", sys.executable, "--no-service"]
        command += ["--home", str(self.home)]
        if os.geteuid() == 0:
            command += ["--user", "root"]
        return subprocess.run([*command, *options], capture_output=True, text=True, check=False)

    def clone(self, source: str, version: str, changes: Mapping[str, tuple[str, str]]) -> None:
        """Install a copy of a release with another version and these changes; see ``bundle``."""
        before, after = (self.prefix / "releases" / each for each in (source, version))
        shutil.copytree(before, after, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", "pip"))
        program = after / "bin/telescope-agent"
        program.write_text(program.read_text().replace(str(before), str(after)))
        packages = next(after.glob("lib/python*/site-packages"))
        for name, (old, new) in {**changes, _VERSION_FILE: (f'"{source}"', f'"{version}"')}.items():
            text = (packages / name).read_text()
            assert old in text, f"{name} does not contain {old!r}"
            (packages / name).write_text(text.replace(old, new, 1))

    def run(self, *arguments: str) -> "subprocess.CompletedProcess[str]":
        """Run a command of the installed agent, outside the repository."""
        return subprocess.run(
            [self.program, *arguments],
            cwd="/",
            env=_environment_variables(),
            capture_output=True,
            text=True,
            check=False,
        )

    def begin(self, *arguments: str) -> "subprocess.Popen[str]":
        """Start a command of the installed agent."""
        return subprocess.Popen(
            [self.program, *arguments],
            cwd="/",
            env=_environment_variables(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    @property
    def pid(self) -> int:
        """Process id of the running agent; 0 between two starts."""
        process = self._process
        return 0 if process is None or process.poll() is not None else process.pid

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        if self._process is not None:
            self._process.terminate()
        self._thread.join()

    def _serve(self) -> None:
        with self.log.open("wb") as log:
            while not self._stopping.is_set():
                self.starts += 1
                self._process = subprocess.Popen(
                    [self.program, "run"], cwd="/", env=_environment_variables(), stdout=log, stderr=log
                )
                if self._stopping.is_set():
                    self._process.terminate()
                self._process.wait()
                self._stopping.wait(0.2)


def _environment_variables() -> dict[str, str]:
    return {"PATH": os.environ["PATH"], "HOME": "/nonexistent"}
