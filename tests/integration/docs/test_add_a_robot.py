"""The page "Add your own robot": who follows it to the letter, from top to bottom, has a robot and a driver."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from tests.harness.cloud.cloud_processes import Ground, start_ground
from tests.harness.paths import ROOT

PAGE = ROOT / "docs" / "guides" / "add-a-robot.md"
BLOCK = re.compile(r"^```(\w+)(?: (\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SERVER = "http://127.0.0.1:8080"
PATIENCE_S = 280


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ground]:
    with start_ground("amqtt", tmp_path_factory.mktemp("page")) as ground:
        yield ground


def follow(page: str, home: Path, url: str, environment: Mapping[str, str]) -> str:
    """Write every named block to its file, run all others as one session of a shell; what the shell said."""
    lines = ["set -eu"]
    for language, name, text in BLOCK.findall(page.replace(SERVER, url)):
        if name:
            assert language != "bash"
            assert name.startswith("~/")
            lines.append(f"cp {home / 'blocks' / name[2:]} {name}")
            kept = home / "blocks" / name[2:]
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(text, encoding="utf-8")
        else:
            assert language == "bash", f"a block of {language} without a file's name"
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
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.mark.timeout(300)
def test_the_page_can_be_followed_from_top_to_bottom(ground: Ground, tmp_path: Path) -> None:
    said = follow(PAGE.read_text(encoding="utf-8"), tmp_path, ground.url, {"TELESCOPE_TOKEN": ground.anna.token})
    assert "type    lever: A lever" in said
    assert "driver  lever" in said
    assert "claim code" in said.lower()
    assert (tmp_path / "lever.png").read_bytes()[:4] == b"\x89PNG"
    assert len(re.findall(r"^\d+ passed", said, re.MULTILINE)) == 2, said
    assert "deselected" in said
    offered = ground.anna.ask("GET", "/robot-types/lever").json()
    assert offered["label"] == "A lever"
