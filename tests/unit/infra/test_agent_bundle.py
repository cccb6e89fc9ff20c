"""The offline bundle: packages for the target, one hash for each file, and equal archives for equal content."""

import hashlib
import tarfile
import tomllib
from pathlib import Path

import pytest

from device_agent.config.release import VERSION
from infra.packaging import bundle
from infra.packaging.bundle import PYTHON_VERSIONS, Pin, Target
from tests.harness.paths import ROOT

AGENT = (ROOT / "requirements/agent.txt").read_text()


def names(target: Target) -> dict[str, str]:
    return {pin.name: pin.version for pin in bundle.pins(AGENT, target)}


def test_markers_are_evaluated_for_the_target_and_not_for_this_machine() -> None:
    assert "lavavu-osmesa" in names(Target("linux_x86_64", "3.12"))
    assert "lavavu-osmesa" not in names(Target("linux_aarch64", "3.12"))
    scipy = [names(Target("linux_aarch64", python))["scipy"] for python in PYTHON_VERSIONS]
    assert scipy[0] != scipy[1] == scipy[2]


def test_every_package_of_every_target_has_hashes() -> None:
    for platform in bundle.PLATFORMS:
        for python in PYTHON_VERSIONS:
            found = bundle.pins(AGENT, Target(platform, python))
            assert {"mujoco-core", "numpy", "msgspec", "cryptography", "paho-mqtt", "ruckig"} <= {p.name for p in found}
            assert all(pin.hashes for pin in found)


def test_the_version_of_the_program_is_that_of_the_distribution() -> None:
    project = tomllib.loads((ROOT / "infra/packaging/telescope-agent/pyproject.toml").read_text())["project"]
    assert project["version"] == VERSION


@pytest.mark.parametrize(
    ("name", "accepted"),
    [
        ("ruckig-0.19.4-cp312-cp312-linux_aarch64.whl", True),
        ("ruckig-0.19.4-cp311-cp311-linux_aarch64.whl", False),
        ("ruckig-0.19.4-cp312-cp312-manylinux_2_28_x86_64.whl", False),
        ("ruckig-0.19.3-cp312-cp312-linux_aarch64.whl", False),
    ],
)
def test_an_own_wheel_is_used_only_if_it_fits(tmp_path: Path, name: str, accepted: bool) -> None:
    own, wheels = tmp_path / "own", tmp_path / "wheels"
    for folder in (own, wheels):
        folder.mkdir()
    (own / name).write_bytes(b"wheel")
    found = bundle._own_wheel(Pin("ruckig", "0.19.4", ()), Target("linux_aarch64", "3.12"), own)
    assert found == (own / name if accepted else None)


def packed(folder: Path, target: Target) -> Path:
    wheels = folder / "bundle" / "wheels"
    wheels.mkdir(parents=True)
    for name in ("numpy-2.4.6-py3-none-any.whl", "ruckig-0.19.4.tar.gz", "cmake-4.4.5-py3-none-any.whl"):
        (wheels / name).write_text(name)
    bundle.write_lists(folder / "bundle", target, version="0.1.0", compiled=["ruckig"])
    bundle._pack(folder / "bundle", folder / "bundle.tar")
    return folder / "bundle.tar"


def test_lists_name_every_file_and_build_tools_are_not_installed(tmp_path: Path) -> None:
    target = Target("linux_aarch64", "3.12")
    with tarfile.open(packed(tmp_path, target)) as archive:
        contents = {
            member.name.partition("/")[2]: file.read() for member in archive if (file := archive.extractfile(member))
        }
    lines = contents.pop("SHA256SUMS").decode().splitlines()
    sums = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
    assert sums == {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    pins = contents["requirements.txt"].decode().splitlines()
    digest = hashlib.sha256(b"ruckig-0.19.4.tar.gz").hexdigest()
    assert [pin.split()[0] for pin in pins] == ["numpy==2.4.6", "ruckig==0.19.4"]
    assert pins[1].endswith(f"--hash=sha256:{digest}")
    assert b"machine=aarch64\npython=3.12\ncompiles=ruckig\n" in contents["BUNDLE"]
    assert contents["install-agent.sh"].startswith(b"#!/bin/sh")


def test_equal_content_gives_an_equal_archive(tmp_path: Path) -> None:
    first, second = (packed(tmp_path / name, Target("linux_x86_64", "3.11")) for name in "ab")
    assert first.read_bytes() == second.read_bytes()
