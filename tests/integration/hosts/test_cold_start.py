"""A function's first caller waits for its imports: they stay near what FastAPI alone takes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.paths import ROOT

LIMIT = 600 / 330
"""Of the time that importing FastAPI takes."""
ROUNDS = 3
PATIENT_ROUNDS = 30
"""A busy machine gets more rounds: only the quickest of each counts."""
FASTAPI = "import fastapi"
NOTHING = "pass"


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
    ("code", "there"),
    [
        ("import function_app.entrypoints.http, function_app.bootstrap", NOTHING),
        # Azure's worker has the binding classes before it looks for functions.
        ("import function_app; function_app.app", "import azure.functions"),
        ("import function_app.entrypoints.hosts.aws", NOTHING),
    ],
    ids=["application", "azure", "lambda"],
)
def test_the_cold_import_stays_near_fastapis_own(code: str, there: str, byte_code: Path) -> None:
    codes = (FASTAPI, code, there, NOTHING)
    for each in codes:
        importing_s(each, byte_code)  # leaves its byte code
    least_s = dict.fromkeys(codes, float("inf"))
    ratio = float("inf")
    for done in range(PATIENT_ROUNDS):
        for each in dict.fromkeys(codes):
            least_s[each] = min(least_s[each], importing_s(each, byte_code))
        ratio = (least_s[code] - least_s[there] + least_s[NOTHING]) / least_s[FASTAPI]
        if done >= ROUNDS - 1 and ratio <= LIMIT:
            return
    pytest.fail(f"{code}: {ratio:.2f} times as long as FastAPI, more than {LIMIT:.2f}")


def test_no_entry_loads_what_only_some_stores_or_other_programs_need() -> None:
    heavy = ("boto3", "botocore", "azure.data", "azure.storage", "azure.identity", "numpy", "jsonschema", "uvicorn")
    code = (
        "import sys, function_app.bootstrap, function_app.entrypoints.hosts.aws, function_app; function_app.app\n"
        f"found = [name for name in {heavy} if name in sys.modules]\n"
        "sys.exit(', '.join(found) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
