"""The three kinds of store, each as the environment variables that select it.

with start_emulator("azure") as emulator:
    environment = empty_store("azure", emulator)
"""

import asyncio
import contextlib
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from function_app import bootstrap
from function_app.adapters.aws.blobs import S3Blobs
from function_app.adapters.aws.tables import DynamoTables
from function_app.settings import read
from tests.harness.stores.aws import CREDENTIALS, REGION, start_moto
from tests.harness.stores.azure import start_azurite

StoreKind = Literal["local", "azure", "aws"]
STORES: tuple[StoreKind, ...] = ("local", "azure", "aws")


@contextlib.contextmanager
def start_emulator(kind: StoreKind) -> Iterator[str]:
    """Run the emulator of a cloud store; yields its address, or an empty string for the local store."""
    if kind == "azure":
        with start_azurite() as connection:
            yield connection
    elif kind == "aws":
        with start_moto() as endpoint:
            yield endpoint
    else:
        yield ""


def empty_store(kind: StoreKind, emulator: str) -> dict[str, str]:
    """Environment variables of an empty store; the local one is in ``TELESCOPE_HOME``."""
    name = f"test{secrets.token_hex(8)}"
    if kind == "azure":
        return {
            "TELESCOPE_STORE": "azure",
            "TELESCOPE_STORAGE_CONNECTION": emulator,
            "TELESCOPE_STORAGE_PREFIX": name,
            "TELESCOPE_STORAGE_CONTAINER": name,
        }
    if kind == "aws":
        return {
            "TELESCOPE_STORE": "aws",
            "TELESCOPE_AWS_REGION": REGION,
            "TELESCOPE_AWS_TABLE": name,
            "TELESCOPE_AWS_BUCKET": name,
            "TELESCOPE_AWS_ENDPOINT": emulator,
            **CREDENTIALS,
        }
    return {"TELESCOPE_STORE": "local"}


def make_places(home: Path, environment: dict[str, str]) -> None:
    """Create the table and bucket on AWS, as a deployment does. Requires credentials in this process."""

    async def prepare() -> None:
        functions = bootstrap.build(read({"TELESCOPE_HOME": str(home), **environment}))
        if isinstance(functions.tables, DynamoTables):
            await functions.tables.prepare()
        if isinstance(functions.blobs, S3Blobs):
            await functions.blobs.prepare()
        await functions.close()

    asyncio.run(prepare())
