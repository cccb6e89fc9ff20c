"""The install script: clear errors before anything changes, verified bundles, repetition and removal."""

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.harness.agent.agent_bundle import SCRIPT, InstalledAgent, build_wheel, bundle

pytestmark = pytest.mark.timeout(1800)  # as in test_update


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture
def agent(tmp_path: Path) -> InstalledAgent:
    return InstalledAgent(tmp_path)


def script(*options: str, path: str = "") -> str:
    """Run the script, which must fail; returns its message."""
    environment = {"PATH": f"{path}:{os.environ['PATH']}", "HOME": "/nonexistent"}
    done = subprocess.run(["sh", SCRIPT, *options], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode != 0, done
    assert "Traceback" not in done.stderr
    return done.stderr


def program(folder: Path, name: str, text: str) -> Path:
    file = folder / name
    file.write_text(f"#!/bin/sh\n{text}\n")
    file.chmod(0o755)
    return file


def test_wrong_options_are_named(tmp_path: Path) -> None:
    assert "unknown option --colour" in script("--colour")
    assert "--prefix needs a value" in script("--prefix")
    assert "exclude each other" in script("--prefix", str(tmp_path), "--version", "1", "--bundle", "x")
    assert "contains no agent" in script("--prefix", str(tmp_path), "--uninstall")


def test_an_unsuitable_machine_is_reported_before_anything_changes(tmp_path: Path) -> None:
    prefix = tmp_path / "prefix"
    old = program(tmp_path, "python-old", "exit 1")
    assert "Python 3.11 or newer is missing" in script("--prefix", str(prefix), "--python", str(old))
    bare = program(tmp_path, "python-bare", 'case "$2" in *ensurepip*) exit 1 ;; esac')
    assert "apt-get install python3-venv" in script("--prefix", str(prefix), "--python", str(bare))
    program(tmp_path, "df", "echo; echo /dev/sda 9 9 2048 1% /")
    assert "has 2 MB left" in script("--prefix", str(prefix), "--python", sys.executable, path=str(tmp_path))
    assert not prefix.exists()


def test_without_rights_the_remedy_is_named(tmp_path: Path) -> None:
    if os.geteuid() == 0:
        command = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "sh"]
        readable = Path("/tmp") / f"install-agent-{os.getpid()}.sh"
        readable.write_text(SCRIPT.read_text())
        readable.chmod(0o644)
    else:
        command, readable = ["sh"], SCRIPT
    prefix = tmp_path / "prefix" if os.geteuid() == 0 else Path("/telescope-agent")
    try:
        done = subprocess.run([*command, readable, "--prefix", prefix], capture_output=True, text=True, check=False)
    finally:
        if readable != SCRIPT:
            readable.unlink()
    assert done.returncode == 1
    assert "run as root, or choose a folder with --prefix" in done.stderr


def changed(folder: Path, name: str, old: str, new: str) -> None:
    file = folder / name
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def sums(folder: Path, name: str) -> None:
    """Correct the checksum of a changed file."""
    lines = [line for line in (folder / "SHA256SUMS").read_text().splitlines() if not line.endswith(f"  {name}")]
    lines.append(f"{hashlib.sha256((folder / name).read_bytes()).hexdigest()}  {name}")
    (folder / "SHA256SUMS").write_text("\n".join(lines) + "\n")


def test_a_damaged_or_foreign_bundle_is_not_installed(agent: InstalledAgent, wheel: Path, tmp_path: Path) -> None:
    good = bundle(tmp_path, wheel, "0.1.0")

    def refusal() -> str:
        done = agent.install("--bundle", str(good))
        assert done.returncode == 1, done
        return done.stderr

    assert "does not exist" in agent.install("--bundle", str(tmp_path / "missing")).stderr
    (tmp_path / "text.tar").write_text("no archive")
    assert "is not an offline bundle" in agent.install("--bundle", str(tmp_path / "text.tar")).stderr
    (good / "wheels/more.whl").touch()
    assert "wheels/more.whl is missing or not listed" in refusal()
    (good / "wheels/more.whl").unlink()
    changed(good, "BUNDLE", "machine=", "machine=other-")
    assert "BUNDLE differs from SHA256SUMS" in refusal()
    sums(good, "BUNDLE")
    assert "this bundle is for other-" in refusal()
    assert not (agent.prefix / "current").exists()


def test_a_dry_run_changes_nothing(agent: InstalledAgent, wheel: Path, tmp_path: Path) -> None:
    done = agent.install("--bundle", str(bundle(tmp_path, wheel, "0.1.0")), "--dry-run")
    assert done.returncode == 0, done.stderr
    assert f"would install release 0.1.0 in {agent.prefix}" in done.stderr
    assert not agent.prefix.exists()


@pytest.mark.long
def test_an_interrupted_installation_is_repeated_and_a_wrong_hash_leaves_the_release_in_use(
    agent: InstalledAgent, wheel: Path, tmp_path: Path
) -> None:
    first = bundle(tmp_path, wheel, "0.1.0")
    command = ["sh", str(SCRIPT), "--prefix", str(agent.prefix), "--home", str(agent.home), "--user", "root"]
    command += ["--no-service"]
    killed = subprocess.Popen([*command, "--python", sys.executable, "--bundle", str(first)], start_new_session=True)
    while not (agent.prefix / "releases/0.1.0/bin").exists():
        time.sleep(0.05)
        assert killed.poll() is None
    os.killpg(killed.pid, signal.SIGKILL)
    killed.wait()
    assert not (agent.prefix / "current").exists()
    for again in ("installing release 0.1.0", "release 0.1.0 is installed already"):
        done = agent.install("--bundle", str(first))
        assert done.returncode == 0, done.stderr
        assert again in done.stderr
    assert agent.run("--version").stdout == "telescope-agent 0.1.0\n"
    second = bundle(tmp_path, wheel, "0.2.0")
    line = next(line for line in (second / "requirements.txt").read_text().splitlines() if "agent==" in line)
    changed(second, "requirements.txt", line, line[:-4] + "0000")
    sums(second, "requirements.txt")
    refused = agent.install("--bundle", str(second))
    assert refused.returncode == 1
    assert "the release in use is unchanged" in refused.stderr.lower()
    assert agent.run("--version").stdout == "telescope-agent 0.1.0\n"
    assert "in use     0.1.0" in agent.run("release").stdout
    removed = agent.install("--uninstall")
    assert removed.returncode == 0, removed.stderr
    assert (agent.prefix.exists(), agent.home.exists()) == (False, True)
