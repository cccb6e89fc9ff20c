"""An emulated Azure for tests: Azurite, from npm.

with start_azurite() as connection:
    tables = AzureTables(connection=connection, prefix="test")
"""

import contextlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Timer

FOLDER = Path(__file__).resolve().parents[1] / "azurite"
PROGRAM = FOLDER / "node_modules" / "azurite" / "dist" / "src" / "azurite.js"
HOST = "127.0.0.1"
ACCOUNT = "devstoreaccount1"
KEY = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="
"""Azurite's, known to everybody."""
START_WITHIN_S = 60
_LISTENS = re.compile(r"Azurite (Blob|Table) service is successfully listening at http://127\.0\.0\.1:(\d+)")


@contextlib.contextmanager
def start_azurite() -> Iterator[str]:
    """Azurite with nothing in it, on free loopback ports; gives its connection string."""
    assert PROGRAM.exists(), f"Azurite is not installed; run `npm ci --prefix {FOLDER}`, as `make test` does"
    places = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    node = shutil.which("node", path=places)
    assert node, "Node.js is not installed; `make test` installs it"
    arguments = ["--inMemoryPersistence", "--skipApiVersionCheck", "--disableTelemetry", "--silent"]
    ports = [word for service in ("blob", "queue", "table") for word in (f"--{service}Port", "0")]
    with subprocess.Popen(
        [node, "--require", str(FOLDER / "ends-with-stdin.cjs"), str(PROGRAM), *arguments, *ports],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        patience = Timer(START_WITHIN_S, process.kill)
        patience.start()
        try:
            connection = _connection(process)
        finally:
            patience.cancel()
            patience.join()
        try:
            yield connection
        finally:
            process.communicate(timeout=START_WITHIN_S)  # closes its standard input, which ends it


def _connection(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    said, places = [], {}
    for line in process.stdout:
        said.append(line)
        if found := _LISTENS.search(line):
            places[found[1]] = f"http://{HOST}:{found[2]}/{ACCOUNT}"
        if len(places) == 2:
            parts = {"AccountName": ACCOUNT, "AccountKey": KEY}
            parts |= {f"{service}Endpoint": place for service, place in places.items()}
            return ";".join(f"{name}={value}" for name, value in parts.items())
    raise AssertionError(f"Azurite did not start: {''.join(said)}")
