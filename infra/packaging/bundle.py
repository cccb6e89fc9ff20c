"""Builds the offline bundle of the agent for one machine type and Python version; see `make agent-bundle`.

The archive contains the wheels of the agent and of its pinned dependencies, ``requirements.txt`` with one hash for each
file, ``install-agent.sh``, and ``SHA256SUMS`` of all files. A package without a wheel for the machine is included as
source code, with the wheels that compile it: the machine then needs a C++ compiler.
"""

import argparse
import hashlib
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name, parse_sdist_filename, parse_wheel_filename

ROOT = Path(__file__).resolve().parents[2]
PLATFORMS = {"linux_aarch64": "aarch64", "linux_x86_64": "x86_64"}
"""Name of a platform → ``platform.machine()`` there."""
PYTHON_VERSIONS = ("3.11", "3.12", "3.13")
_GLIBC = ("2_28", "2_27", "2_26", "2_24", "2_17")
"""Wheels for these versions of glibc run on every distribution since Debian 10 and Ubuntu 20.04."""
_SCRIPT = ROOT / "device_agent" / "cli" / "releases" / "install-agent.sh"
_PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input")


class BundleError(Exception):
    """The bundle cannot be built; the text states why."""


@dataclass(frozen=True, slots=True)
class Pin:
    """One package of a requirements file: name, version, and hashes of all its files."""

    name: str
    version: str
    hashes: tuple[str, ...]


@dataclass(slots=True)
class Target:
    """The machine that a bundle is for, and packages that are included as source code although a wheel exists."""

    platform: str
    python: str
    compiled: set[str] = field(default_factory=set)

    @property
    def environment(self) -> dict[str, str]:
        """Values of environment markers on that machine."""
        return {
            "implementation_name": "cpython",
            "implementation_version": f"{self.python}.0",
            "os_name": "posix",
            "platform_machine": PLATFORMS[self.platform],
            "platform_python_implementation": "CPython",
            "platform_system": "Linux",
            "python_full_version": f"{self.python}.0",
            "python_version": self.python,
            "sys_platform": "linux",
        }

    @property
    def options(self) -> list[str]:
        """Options of ``pip download`` for wheels of that machine."""
        machine, number = PLATFORMS[self.platform], self.python.replace(".", "")
        platforms = [f"manylinux_{glibc}_{machine}" for glibc in _GLIBC] + [f"manylinux2014_{machine}"]
        options = ["--only-binary", ":all:", "--python-version", self.python, "--implementation", "cp"]
        options += [word for tag in platforms for word in ("--platform", tag)]
        return options + [word for abi in (f"cp{number}", "abi3", "none") for word in ("--abi", abi)]


def pins(text: str, target: Target) -> list[Pin]:
    """The packages of an exported requirements file that the target needs."""
    found = []
    for entry in re.split(r"\n(?=\S)", text):
        if "==" not in entry or entry.startswith("#"):
            continue
        requirement = Requirement(entry.partition("\\")[0].strip())
        if requirement.marker is None or requirement.marker.evaluate(target.environment):
            version = str(requirement.specifier).removeprefix("==")
            found.append(Pin(requirement.name, version, tuple(re.findall(r"--hash=(\S+)", entry))))
    return found


def download(pin: Pin, target: Target, wheels: Path, own: Path | None) -> bool:
    """Download the wheel of a package, or its source code; returns whether the target must compile it.

    ``own``: folder with wheels that were built on such a machine; they are preferred.

    Raises:
        BundleError: There is neither.
    """
    if own is not None and (built := _own_wheel(pin, target, own)) is not None:
        shutil.copy(built, wheels)
        return False
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write(f"{pin.name}=={pin.version} {' '.join(f'--hash={each}' for each in pin.hashes)}\n")
        file.flush()
        command = [
            *_PIP,
            "download",
            "--quiet",
            "--no-deps",
            "--require-hashes",
            "--dest",
            str(wheels),
            "-r",
            file.name,
        ]
        done = None
        if pin.name not in target.compiled:
            done = subprocess.run([*command, *target.options], capture_output=True, text=True, check=False)  # noqa: S603
            if done.returncode == 0:
                return False
        source = subprocess.run([*command, "--no-binary", pin.name], capture_output=True, text=True, check=False)  # noqa: S603
    if source.returncode:
        raise BundleError(f"{pin.name} {pin.version} cannot be downloaded:\n{(done or source).stderr[-500:]}")
    return True


def _own_wheel(pin: Pin, target: Target, own: Path) -> Path | None:
    number = f"cp{target.python.replace('.', '')}"
    for file in sorted(own.glob("*.whl")):
        name, version, _, tags = parse_wheel_filename(file.name)
        fits = any(
            tag.platform.endswith(PLATFORMS[target.platform]) and tag.interpreter in {number, "py3"} for tag in tags
        )
        if name == canonicalize_name(pin.name) and str(version) == pin.version and fits:
            return file
    return None


def write_lists(folder: Path, target: Target, *, version: str, compiled: list[str]) -> None:
    """Write ``requirements.txt``, ``BUNDLE`` and ``SHA256SUMS`` for the downloaded packages."""
    builders = {pin.name for pin in pins(_read("agent-build"), target)}
    builders -= {pin.name for pin in pins(_read("agent"), target)}
    lines = []
    for file in sorted((folder / "wheels").iterdir()):
        name, number = parse_wheel_filename(file.name)[:2] if file.suffix == ".whl" else parse_sdist_filename(file.name)
        if name not in builders:
            lines.append(f"{name}=={number} --hash=sha256:{_digest(file)}\n")
    (folder / "requirements.txt").write_text("".join(lines), encoding="utf-8")
    settings = {"version": version, "machine": PLATFORMS[target.platform], "python": target.python}
    settings["compiles"] = " ".join(compiled)
    (folder / "BUNDLE").write_text("".join(f"{key}={value}\n" for key, value in settings.items()), encoding="utf-8")
    shutil.copy(_SCRIPT, folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    sums = "".join(f"{_digest(path)}  {path.relative_to(folder)}\n" for path in files)
    (folder / "SHA256SUMS").write_text(sums, encoding="utf-8")


def build(target: Target, output: Path, own: Path | None) -> Path:
    """Build a bundle; returns the path of the archive. Equal content gives an equal archive.

    Raises:
        BundleError: A package cannot be downloaded, or the wheel of the agent cannot be built.
    """
    with tempfile.TemporaryDirectory() as temporary:
        wheels = Path(temporary, "wheels")
        wheels.mkdir()
        command = [*_PIP, "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(wheels)]
        done = subprocess.run([*command, str(Path(__file__).parent / "telescope-agent")], check=False)  # noqa: S603
        if done.returncode:
            raise BundleError("the wheel of the agent cannot be built; the reason is above")
        version = str(parse_wheel_filename(next(wheels.iterdir()).name)[1])
        compiled = [pin.name for pin in pins(_read("agent"), target) if download(pin, target, wheels, own)]
        for pin in pins(_read("agent-build"), target) if compiled else ():
            download(pin, target, wheels, own)
        folder = Path(temporary, f"telescope-agent-{version}-{target.platform}-py{target.python.replace('.', '')}")
        folder.mkdir()
        wheels.rename(folder / "wheels")
        write_lists(folder, target, version=version, compiled=compiled)
        output.mkdir(parents=True, exist_ok=True)
        archive = output / f"{folder.name}.tar"
        _pack(folder, archive)
    for name in compiled:
        sys.stderr.write(f"telescope: {name} has no wheel for {target.platform}; the bundle contains its source code\n")
    return archive


def _pack(folder: Path, archive: Path) -> None:
    def neutral(entry: tarfile.TarInfo) -> tarfile.TarInfo:
        entry.uid = entry.gid = entry.mtime = 0
        entry.uname = entry.gname = "root"
        entry.mode = 0o755 if entry.isdir() or entry.name.endswith(".sh") else 0o644
        return entry

    partial = archive.with_suffix(".part")
    with tarfile.open(partial, "w") as file:  # wheels are compressed already
        for path in (folder, *sorted(folder.rglob("*"))):
            file.add(path, arcname=path.relative_to(folder.parent), recursive=False, filter=neutral)
    partial.replace(archive)


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _read(name: str) -> str:
    return (ROOT / "requirements" / f"{name}.txt").read_text(encoding="utf-8")


def main() -> int:
    """Build the bundle that the command line names; prints its path."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--platform", choices=sorted(PLATFORMS), default="linux_x86_64", help="machine of the robot")
    parser.add_argument("--python", choices=PYTHON_VERSIONS, default="3.11", help="Python version of the robot")
    parser.add_argument("--wheels", type=Path, help="folder with own wheels, for packages without a published one")
    parser.add_argument("--compile", action="append", default=[], metavar="NAME", help="include source code of NAME")
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="folder of the archive")
    options = parser.parse_args()
    try:
        archive = build(Target(options.platform, options.python, set(options.compile)), options.output, options.wheels)
    except BundleError as error:
        sys.stderr.write(f"telescope: {error}\n")
        return 1
    sys.stdout.write(f"{archive}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
