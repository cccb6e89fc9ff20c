"""An installation whose releases are shell scripts, with the real launcher."""

import shutil
import subprocess
from pathlib import Path

from device_agent.cli.releases.installation import COMPLETE_FILE, Installation
from tests.harness.paths import ROOT

LAUNCHER = ROOT / "device_agent/cli/releases/launch.sh"


class StubInstallation:
    """Releases that print their version and their trial; a release on trial can pass or end at once."""

    def __init__(self, folder: Path, *versions: str, user: str = "") -> None:
        self.prefix, self.home = folder / "prefix", folder / "home"
        self.home.mkdir(parents=True, mode=0o700)
        (self.prefix / "bin").mkdir(parents=True)
        (self.prefix / "installation").write_text(f"home={self.home}\nuser={user}\n")
        shutil.copy(LAUNCHER, self.prefix / "bin/telescope-agent")
        (self.prefix / "bin/telescope-agent").chmod(0o755)
        for version in versions:
            self.add(version)
        self.installation = Installation(self.prefix)
        self.installation.link("current", versions[0] if versions else "")

    def add(self, version: str, script: str = "") -> None:
        """Install a release; ``script`` runs before it prints its version."""
        program = self.prefix / "releases" / version / "bin/telescope-agent"
        program.parent.mkdir(parents=True)
        program.write_text(f'#!/bin/sh\n{script}\necho "{version} ${{TELESCOPE_TRIAL-}}"\n')
        program.chmod(0o755)
        (self.prefix / "releases" / version / COMPLETE_FILE).touch()

    def run(self, *arguments: str) -> "subprocess.CompletedProcess[str]":
        """Start the launcher."""
        return subprocess.run(
            [self.prefix / "bin/telescope-agent", *(arguments or ("run",))],
            env={"PATH": "/usr/bin:/bin"},
            capture_output=True,
            text=True,
            check=False,
        )

    def started(self) -> str:
        """The release that the launcher starts now."""
        done = self.run()
        assert done.returncode == 0, done
        return done.stdout.split()[0]

    @property
    def links(self) -> tuple[str, str]:
        """The releases in use and before."""
        return self.installation.linked("current"), self.installation.linked("previous")

    def write_result(self, result: str) -> None:
        """Write the result of the present trial, as the agent does."""
        trial = self.installation.trial()
        assert trial is not None
        (self.home / "release-trial").write_text(f"{trial.trial} {result}\n")
