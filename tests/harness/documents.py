"""Fenced code blocks of Markdown pages, and how tests execute them.

A comment on the line before a block states its use: ``<!-- runs: NAME -->`` executes it, ``<!-- file: PATH -->`` stores
it as a file for the executed blocks, ``<!-- example: REASON -->`` states why it cannot be executed.
"""

import os
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.harness.paths import ROOT

SERVER = "http://127.0.0.1:8080"
"""Address in the pages that tests replace with that of their own server."""
TIMEOUT_S = 280
_BLOCK = re.compile(
    r"^(?:<!-- (?P<use>runs|file|example): (?P<argument>.+?) -->\n)?```(?P<language>\w*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    language: str
    use: str
    """``runs``, ``file``, ``example``, or empty."""
    argument: str
    text: str


def blocks(page: Path) -> list[Block]:
    found = _BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [Block(each["language"], each["use"] or "", each["argument"] or "", each["text"]) for each in found]


def block(page: Path, use: str, argument: str) -> str:
    """The text of the only block with this use and argument."""
    (text,) = [each.text for each in blocks(page) if (each.use, each.argument) == (use, argument)]
    return text


def follow(page: Path, home: Path, environment: Mapping[str, str], url: str = SERVER) -> str:
    """Execute a page from top to bottom in one shell session whose home is ``home``; returns the output."""
    lines = ["set -eu"]
    for number, each in enumerate(blocks(page)):
        text = each.text.replace(SERVER, url)
        if each.use == "file":
            assert each.argument.startswith("~/"), each.argument
            source = home / "blocks" / str(number)
            source.parent.mkdir(parents=True, exist_ok=True)
            source.write_text(text, encoding="utf-8")
            lines.append(f"mkdir -p $(dirname {each.argument}) && cp {source} {each.argument}")
        elif each.use == "runs":
            lines.append(text)
    done = subprocess.run(
        ["bash", "-c", "\n".join(lines)],
        cwd=ROOT,
        env={
            **os.environ,
            "HOME": str(home),
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONDONTWRITEBYTECODE": "1",
            "UV_OFFLINE": "1",
            "UV_CACHE_DIR": str(home / "uv"),
            **environment,
        },
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout
