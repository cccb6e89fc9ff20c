"""A function's first caller waits for its imports: they stay near what FastAPI alone takes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.hosts.host import ROOT

LIMIT = 600 / 330
"""Of the time that importing FastAPI takes."""
ROUNDS = 7
PATIENT_ROUNDS = 40
"""A busy machine gets more rounds: only the quickest of each counts."""
FASTAPI = "import fastapi"


@pytest.fixture(scope="module")
def byte_code(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("byte-code")


def importing_s(code: str, byte_code: Path) -> float:
    """Processor time of a new Python that does this, with byte code where an earlier one left it."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, env={**environment, "PYTHONPYCACHEPREFIX": str(byte_code)}
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, code
    return used.ru_utime + used.ru_stime


@pytest.mark.parametrize(
    "code",
    [
        "import function_app.entrypoints.http, function_app.bootstrap",
        "import function_app; function_app.app",
        "import function_app.entrypoints.aws",
    ],
    ids=["application", "azure", "lambda"],
)
def test_the_cold_import_stays_near_fastapis_own(code: str, byte_code: Path) -> None:
    for each in (FASTAPI, code):
        importing_s(each, byte_code)  # leaves its byte code
    known_s, ours_s = float("inf"), float("inf")
    for done in range(PATIENT_ROUNDS):
        known_s = min(known_s, importing_s(FASTAPI, byte_code))
        ours_s = min(ours_s, importing_s(code, byte_code))
        if done >= ROUNDS - 1 and ours_s <= LIMIT * known_s:
            return
    pytest.fail(f"{code}: {ours_s / known_s:.2f} times as long as FastAPI, more than {LIMIT:.2f}")


def test_no_entry_loads_what_only_some_stores_or_other_programs_need() -> None:
    heavy = ("boto3", "botocore", "azure.data", "azure.storage", "azure.identity", "numpy", "jsonschema", "uvicorn")
    code = (
        "import sys, function_app.bootstrap, function_app.entrypoints.aws; import function_app; function_app.app\n"
        f"found = [name for name in {heavy} if name in sys.modules]\n"
        "sys.exit(', '.join(found) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
