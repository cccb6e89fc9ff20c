"""What all hosts have in common."""

import contextlib
import os
import select
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Protocol

from tests.harness.paths import ROOT

LOOPBACK = "127.0.0.1"
PATIENCE_S = 60.0
"""How long a test waits for a host [s]: the machine may be busy."""


class HostFailed(Exception):  # noqa: N818 (what a test looks for)
    """A function ended with an error: the cloud would call it again."""


class Host(Protocol):
    """The functions under one host.

    Attributes:
        url: Where requests go, without a slash at its end.
    """

    url: str

    def tick(self) -> None:
        """Fire the timer once, and wait until the round is over.

        Raises:
            HostFailed: The function ended with an error.
        """

    def deliver(self, topic: str, payload: bytes) -> None:
        """Hand over one MQTT message as this cloud does, and wait until it has been taken in.

        Raises:
            HostFailed: The function ended with an error: to be delivered again.
        """


def environment_of(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment of a host's program: this one's, with no settings but those given."""
    own = ("TELESCOPE_", "AWS_", "_HANDLER", "AZURE_", "FUNCTIONS_", "PYTHONPATH")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(own)}
    return {**kept, "PYTHONUNBUFFERED": "1", **environment}


@contextlib.contextmanager
def start_program(
    arguments: Sequence[str], environment: Mapping[str, str], *, folder: Path = ROOT
) -> Iterator["Program"]:
    """A Python program, which ends when its standard input does, or is made to; its words are kept for failures."""
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=folder,
            env=dict(environment),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            text=True,
        )
        program = Program(process, said)
        try:
            yield program
        finally:
            program.end()


def only(package: Path, *programs: str) -> dict[str, str]:
    """What lets a program see the libraries in ``package`` alone, and beside them these of the tests'.

    To be run with ``-S``, so that Python adds none of its own.
    """
    beside = Path(tempfile.mkdtemp(dir=package.parent))
    site = Path(sysconfig.get_path("purelib"))
    for program in programs:
        for found in site.glob(program):
            (beside / found.name).symlink_to(found)
    return {"PYTHONPATH": f"{package}{os.pathsep}{beside}"}


class Program:
    """One that runs."""

    def __init__(self, process: "subprocess.Popen[str]", said: IO[str]) -> None:
        self.process = process
        self._said = said

    def line(self) -> str:
        """Its next line on standard output; fails with what it said when none comes."""
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], PATIENCE_S)
        text = self.process.stdout.readline() if ready else ""
        assert text, f"{self.process.args!r} does not answer: {self.said()}"
        return text.rstrip("\n")

    def tell(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def said(self) -> str:
        """Everything on its standard error so far."""
        with contextlib.suppress(ValueError):
            self._said.seek(0)
            return self._said.read()
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
