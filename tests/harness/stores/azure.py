"""Emulated Azure Storage: Azurite from npm.

with start_azurite() as connection:
    tables = AzureTables(connection=connection, prefix="test")
"""

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path

from tests.harness.node import start_node

FOLDER = Path(__file__).resolve().parents[1] / "azurite"
PROGRAM = FOLDER / "node_modules" / "azurite" / "dist" / "src" / "azurite.js"
ACCOUNT = "devstoreaccount1"
KEY = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="
"""Well-known development credentials of Azurite."""
_LISTENS = re.compile(r"Azurite (Blob|Table) service is successfully listening at (https?://127\.0\.0\.1:\d+)")


@contextlib.contextmanager
def start_azurite(*options: str) -> Iterator[str]:
    """Run an empty Azurite on free loopback ports; yields its connection string."""
    require = ["--require", str(FOLDER / "ends-with-stdin.cjs")]
    settings = ["--inMemoryPersistence", "--skipApiVersionCheck", "--disableTelemetry", "--silent"]
    ports = [word for service in ("blob", "queue", "table") for word in (f"--{service}Port", "0")]
    arguments = [*require, str(PROGRAM), *settings, *ports, *options]
    with start_node(FOLDER, "azurite", arguments, _LISTENS, count=2) as found:
        parts = {"AccountName": ACCOUNT, "AccountKey": KEY}
        parts |= {f"{match[1]}Endpoint": f"{match[2]}/{ACCOUNT}" for match in found}
        yield ";".join(f"{name}={value}" for name, value in parts.items())


def endpoint(connection: str, service: str) -> str:
    """The address of one service in a connection string."""
    return dict(part.split("=", 1) for part in connection.split(";"))[f"{service}Endpoint"]


def through(connection: str, proxy: str, service: str) -> str:
    """The connection string with the address of a proxy for one service."""
    return connection.replace(endpoint(connection, service), f"{proxy}/{ACCOUNT}")
