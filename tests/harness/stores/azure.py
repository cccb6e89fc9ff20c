"""An emulated Azure for tests: Azurite, from npm.

with start_azurite() as connection:
    tables = AzureTables(connection=connection, prefix="test")
"""

import asyncio
import contextlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Timer

from function_app.adapters.azure.client import Place
from function_app.adapters.azure.tables import AzureTables
from function_app.ports.tables import Conflict, Row

FOLDER = Path(__file__).resolve().parents[1] / "azurite"
PROGRAM = FOLDER / "node_modules" / "azurite" / "dist" / "src" / "azurite.js"
ACCOUNT = "devstoreaccount1"
KEY = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="
"""Well-known development credentials of Azurite."""
START_WITHIN_S = 60
_LISTENS = re.compile(r"Azurite (Blob|Table) service is successfully listening at (https?://127\.0\.0\.1:\d+)")


@contextlib.contextmanager
def start_azurite(*options: str) -> Iterator[str]:
    """Azurite with nothing in it, on free loopback ports; gives its connection string."""
    assert PROGRAM.exists(), f"Azurite is not installed; run `npm ci --prefix {FOLDER}`, as `make test` does"
    places = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    node = shutil.which("node", path=places)
    assert node, "Node.js is not installed; `make test` installs it"
    arguments = ["--inMemoryPersistence", "--skipApiVersionCheck", "--disableTelemetry", "--silent"]
    ports = [word for service in ("blob", "queue", "table") for word in (f"--{service}Port", "0")]
    with subprocess.Popen(
        [node, "--require", str(FOLDER / "ends-with-stdin.cjs"), str(PROGRAM), *arguments, *ports, *options],
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


def endpoint(connection: str, service: str) -> str:
    """The address of one service in a connection string."""
    return dict(part.split("=", 1) for part in connection.split(";"))[f"{service}Endpoint"]


def through(connection: str, wire: str, service: str) -> str:
    """The same connection, with one service reached at another address."""
    place = endpoint(connection, service)
    return connection.replace(place, f"{wire}/{ACCOUNT}")


async def count_up(connection: str, prefix: str, rounds: int) -> int:
    """Count up in one row as several may do at once; how often another was first."""
    tables, lost, done = AzureTables(place=Place(connection), prefix=prefix), 0, 0
    while done < rounds:
        row = await tables.get("T", "p", "k")
        try:
            if row is None:
                await tables.create("T", Row("p", "k", {"n": 1}))
            else:
                await tables.replace("T", Row("p", "k", {"n": row.data["n"] + 1}, row.etag))
            done += 1
        except Conflict:
            lost += 1
    await tables.close()
    return lost


def run_count_up(connection: str, prefix: str, rounds: int) -> int:
    """The same, for a process of its own."""
    return asyncio.run(count_up(connection, prefix, rounds))


def _connection(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    said, places = [], {}
    for line in process.stdout:
        said.append(line)
        if found := _LISTENS.search(line):
            places[found[1]] = f"{found[2]}/{ACCOUNT}"
        if len(places) == 2:
            parts = {"AccountName": ACCOUNT, "AccountKey": KEY}
            parts |= {f"{service}Endpoint": place for service, place in places.items()}
            return ";".join(f"{name}={value}" for name, value in parts.items())
    raise AssertionError(f"Azurite did not start: {''.join(said)}")
