"""Imports delay the first request to a function; they take little longer than those of FastAPI."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.paths import ROOT

LIMIT = 600 / 330
"""Maximum import time as a multiple of FastAPI's."""
MAX_ROUNDS = 30
"""Maximum number of rounds on a busy machine; the shortest time of each import counts."""
MEASURE = """
import time
startup_s = time.process_time()
{present}
present_s = time.process_time()
{code}
print(startup_s + time.process_time() - present_s)
"""


@pytest.fixture(scope="module")
def byte_code(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("byte-code")


def importing_s(code: str, byte_code: Path, present: str = "") -> float:
    """Processor time in which a new Python process imports this [s], with the byte code of earlier runs."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = str(byte_code)
    command = [sys.executable, "-c", MEASURE.format(present=present, code=code)]
    return float(subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, check=True).stdout)


@pytest.mark.parametrize(
    ("present", "code"),
    [
        ("", "import function_app.entrypoints.http, function_app.bootstrap"),
        # Azure's worker imports the binding classes before it indexes functions.
        ("import azure.functions", "import function_app; function_app.app"),
        ("", "import function_app.entrypoints.hosts.aws"),
    ],
    ids=["application", "azure", "lambda"],
)
def test_the_cold_import_takes_little_longer_than_fastapis(present: str, code: str, byte_code: Path) -> None:
    importing_s(code, byte_code, present)  # writes the byte code
    code_s, fastapi_s = [], []
    for _ in range(MAX_ROUNDS):
        code_s.append(importing_s(code, byte_code, present))
        fastapi_s.append(importing_s("import fastapi", byte_code))
        ratio = min(code_s) / min(fastapi_s)
        if len(code_s) > 1 and ratio <= LIMIT:
            return
    pytest.fail(f"{code}: {ratio:.2f} times as long as FastAPI, more than {LIMIT:.2f}")


def test_no_entry_point_imports_modules_of_other_stores_or_programs() -> None:
    heavy = ("boto3", "botocore", "azure.data", "azure.storage", "azure.identity", "numpy", "jsonschema", "uvicorn")
    code = (
        "import sys, function_app.bootstrap, function_app.entrypoints.hosts.aws, function_app; function_app.app\n"
        f"found = [name for name in {heavy} if name in sys.modules]\n"
        "sys.exit(', '.join(found) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
