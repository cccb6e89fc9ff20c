"""Runs one target under the fuzzer in its own process and parses the libFuzzer output."""

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.harness.paths import ROOT

HEAD = """| parser | inputs tried | edges: an empty input | the examples | in the end |
| --- | ---: | ---: | ---: | ---: |"""
_REACHED = re.compile(r"^#[0-9]+\s+(INITED|DONE)\s+cov: ([0-9]+)", re.MULTILINE)
_DONE = re.compile(r"^Done ([0-9]+) runs", re.MULTILINE)


class Crashed(Exception):  # noqa: N818 (an outcome that the fuzzer expects)
    """A parser raised an undocumented exception; the text is the fuzzer's output with the input."""


@dataclass(frozen=True, slots=True)
class Session:
    """Coverage of one run: branches of the parser ("edges")."""

    name: str
    runs: int
    empty: int
    examples: int
    end: int

    @property
    def row(self) -> str:
        return f"| {self.name} | {self.runs:,} | {self.empty} | {self.examples} | {self.end} |"


def fuzz(names: Sequence[str], *options: str) -> Iterator[Session]:
    """Run targets sequentially with these libFuzzer options.

    Raises:
        Crashed: A target found an error.
    """
    with tempfile.TemporaryDirectory(prefix="ts-fuzz-") as folder:
        done = subprocess.run(
            [sys.executable, "-m", "tests.security.fuzz.run", folder, ",".join(names), *options],
            cwd=ROOT, capture_output=True, text=True, errors="replace", check=False,
        )  # fmt: skip
        for name in names:
            outputs = [_output(Path(folder) / file) for file in (f"{name}-empty", name)]
            if any(_DONE.search(text) is None for text in outputs):
                raise Crashed(f"{name}: {done.stderr[-2000:]}{''.join(outputs)[-4000:]}")
            empty, reached = (dict(_REACHED.findall(text)) for text in outputs)
            runs = re.findall(_DONE, outputs[1])[-1]
            yield Session(name, int(runs), int(empty["INITED"]), int(reached["INITED"]), int(reached["DONE"]))
        if done.returncode:
            raise Crashed(done.stderr[-2000:])


def _output(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""
