"""``prepare`` creates the table and the bucket; without them the error message names it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.hosts.host import PATIENCE_S
from tests.harness.paths import ROOT
from tests.harness.stores.aws import REGION, reset, start_moto, use_credentials


def test_without_its_table_a_program_ends_with_one_line_and_prepare_makes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_credentials(monkeypatch)
    with start_moto() as endpoint:
        reset(endpoint)  # it remembers what other tests of this process have made
        environment = {
            **os.environ,
            "TELESCOPE_HOME": str(tmp_path),
            "TELESCOPE_STORE": "aws",
            "TELESCOPE_AWS_REGION": REGION,
            "TELESCOPE_AWS_BUCKET": "bucket",
            "TELESCOPE_AWS_ENDPOINT": endpoint,
        }

        def run(command: str) -> tuple[int, str, str]:
            done = subprocess.run(
                [sys.executable, "-m", "function_app", command],
                cwd=ROOT,
                env=environment,
                capture_output=True,
                text=True,
                timeout=PATIENCE_S,
                check=False,
            )
            return done.returncode, done.stdout, done.stderr

        for command in ("serve", "work", "sign-in-link"):
            code, out, err = run(command)
            assert (code, out, err.count("\n")) == (1, "", 1), err
            assert "the DynamoDB table 'telescope' in eu-west-1" in err
            assert "`python -m function_app prepare`" in err
        assert [run("prepare") for _ in range(2)] == [(0, "", "")] * 2
        code, out, err = run("sign-in-link")
        assert (code, err) == (0, "")
        assert "#sign-in=" in out
