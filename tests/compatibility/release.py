"""The released agent and server, from the history of this repository."""

import subprocess
from pathlib import Path

from tests.harness.paths import ROOT

RELEASE = "7dd838ca61021ffdf9380bdba1ac7d8eae599103"
"""Commit of the newest release: an ancestor of this one. Set it to the released commit after each release."""
PARTS = ("function_app", "device_agent", "infra", "robots")


class ReleaseUnavailableError(Exception):
    """The repository lacks the commit; the text says what to do."""


def unpack(folder: Path, *, release: str = RELEASE, repository: Path = ROOT) -> Path:
    """Write the programs of the release to ``folder``.

    Raises:
        ReleaseUnavailableError: The clone is shallow, or the commit is not part of its history.
    """
    if _git(repository, "merge-base", "--is-ancestor", release, "HEAD").returncode:
        shallow = _git(repository, "rev-parse", "--is-shallow-repository").stdout.strip() == b"true"
        advice = (
            "The clone is shallow; run `git fetch --unshallow`."
            if shallow
            else "Set RELEASE in tests/compatibility/release.py to an ancestor of this commit."
        )
        raise ReleaseUnavailableError(f"The released commit {release} is not part of the history. {advice}")
    archive = _git(repository, "archive", release, *PARTS).stdout
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive, check=True)
    return folder


def _git(repository: Path, *arguments: str) -> "subprocess.CompletedProcess[bytes]":
    return subprocess.run(["git", *arguments], cwd=repository, capture_output=True, check=False)
