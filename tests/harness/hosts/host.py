"""The interface of all hosts, and programs as child processes."""

import contextlib
import os
import select
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Protocol

from infra.function_package import PYTHON
from tests.harness.paths import ROOT

LOOPBACK = "127.0.0.1"
PATIENCE_S = 60.0
"""Timeout for a host's response [s]; generous, because the machine may be busy."""


class HostFailed(Exception):  # noqa: N818 (an outcome that tests expect)
    """A function failed; the cloud would call it again."""


class Host(Protocol):
    """The functions under one host.

    Attributes:
        url: Base URL of requests, without a trailing slash.
    """

    url: str

    def tick(self) -> None:
        """Fire the timer once and wait for the end of the function.

        Raises:
            HostFailed: The function failed.
        """

    def deliver(self, topic: str, payload: bytes) -> None:
        """Deliver one MQTT message as this cloud does, and wait until it is processed.

        Raises:
            HostFailed: The function failed, so the cloud would deliver the message again.
        """


def environment_of(environment: Mapping[str, str]) -> dict[str, str]:
    """This process's environment without product and cloud settings, plus ``environment``."""
    own = ("TELESCOPE_", "AWS_", "_HANDLER", "AZURE_", "FUNCTIONS_", "PYTHONPATH")
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(own)}
    return {**inherited, "PYTHONUNBUFFERED": "1", **environment}


@contextlib.contextmanager
def start_program(
    arguments: Sequence[str], environment: Mapping[str, str], *, folder: Path = ROOT, python: str = sys.executable
) -> Iterator["Program"]:
    """Run a Python program until the context exits; its standard error is available for failure messages."""
    with tempfile.TemporaryFile("w+") as stderr:
        process = subprocess.Popen(
            [python, *arguments],
            cwd=folder,
            env=dict(environment),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        )
        program = Program(process, stderr)
        try:
            yield program
        finally:
            program.end()


def cloud_python(cloud: str) -> str:
    """The interpreter of the version that a cloud runs, if this machine has it; otherwise this one."""
    return interpreter(PYTHON[cloud])


def interpreter(version: str) -> str:
    """An interpreter of a version such as ``3.12``, if this machine has it; otherwise this one."""
    installed = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for candidate in (shutil.which(f"python{version}"), *installed.glob(f"{version}.*/bin/python")):
        # A shim of pyenv exists for versions that are not enabled; it fails.
        if candidate and subprocess.run([candidate, "-c", ""], capture_output=True, check=False).returncode == 0:
            return str(candidate)
    return sys.executable


def isolated_path(package: Path, *programs: str) -> dict[str, str]:
    """Environment in which only the libraries in ``package`` and these test programs can be imported.

    Start Python with ``-S``, so that it does not add its own site packages.
    """
    links = Path(tempfile.mkdtemp(dir=package.parent))
    site = Path(sysconfig.get_path("purelib"))
    for program in programs:
        for found in site.glob(program):
            (links / found.name).symlink_to(found)
    return {"PYTHONPATH": f"{package}{os.pathsep}{links}"}


class Program:
    """A running program with pipes."""

    def __init__(self, process: "subprocess.Popen[str]", stderr: IO[str]) -> None:
        self.process = process
        self._stderr = stderr

    def read_line(self) -> str:
        """The next line of standard output. Fails with the standard error after a timeout."""
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], PATIENCE_S)
        text = self.process.stdout.readline() if ready else ""
        assert text, f"{self.process.args!r} does not respond: {self.stderr()}"
        return text.rstrip("\n")

    def write_line(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def stderr(self) -> str:
        """The standard error so far."""
        with contextlib.suppress(ValueError):
            self._stderr.seek(0)
            return self._stderr.read()
        return ""

    def end(self) -> None:
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
        self.process.terminate()
        try:
            self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
