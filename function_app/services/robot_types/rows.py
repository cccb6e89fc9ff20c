"""Rows of an account's robot types, and the reminders for validation and cleanup.

Each type has its own partition and blob prefix. In ``ModelChecks``, partition ``checks`` contains validation jobs, and
partition ``looks`` contains cleanup reminders, which also complete interrupted operations.
"""

from dataclasses import dataclass

from function_app.domain.common.ids import ID
from function_app.domain.identity.accounts import Identity
from function_app.domain.robot_types.robot_types import TypeHead, TypeVersion
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.storage import records

HEAD = "type"
VERSIONS = "version:"
CHECKS = "checks"
LOOKS = "looks"
INDEX = "type:"
REPORT = "looked.json"
"""Name of the stored ``ModelReport`` of a version. No uploaded file can have this name."""
PREVIEWS = "type-look:"
_PREVIEW = "~"


@dataclass(frozen=True, slots=True)
class Place:
    """The place of a robot type."""

    account: str
    type: str

    @property
    def trial(self) -> bool:
        """Whether it is a preview; no robot type has such an id."""
        return self.type.startswith(_PREVIEW)

    @property
    def partition(self) -> str:
        """Partition of its rows."""
        return f"{self.account}/{self.type}"

    def prefix(self, version: int) -> str:
        """Blob prefix of one version."""
        return f"robot-types/{self.account}/{self.type}/{version}/"


def place(caller: Identity, robot_type: str) -> Place | None:
    """The place of a type, or ``None`` for an invalid id."""
    return Place(caller.account, robot_type) if ID.match(robot_type) else None


def preview_place(caller: Identity, look: str) -> Place | None:
    """The place of a preview, which is not found by type id."""
    return Place(caller.account, _PREVIEW + look) if ID.match(look) else None


def preview_index(where: Place) -> str:
    """Row key in the account's list of previews."""
    return PREVIEWS + where.type.removeprefix(_PREVIEW)


def version_key(version: int) -> str:
    """Row key of a version."""
    return f"{VERSIONS}{version:08d}"


async def read_head(tables: Tables, where: Place) -> tuple[Row | None, TypeHead | None]:
    """The deciding row of a type, and its content."""
    row = await tables.get(records.ROBOT_TYPES, where.partition, HEAD)
    return row, None if row is None else records.read(row, TypeHead)


async def read_version(tables: Tables, where: Place, version: int) -> tuple[Row | None, TypeVersion | None]:
    """The row of a version, and its content."""
    row = await tables.get(records.ROBOT_TYPES, where.partition, version_key(version))
    return row, None if row is None else records.read(row, TypeVersion)


async def schedule_check(tables: Tables, where: Place, due_ms: int) -> None:
    """Schedule the cleanup of a type at ``due_ms``. Idempotent."""
    try:
        await tables.create(records.MODEL_CHECKS, Row(LOOKS, f"{due_ms:013d}:{where.partition}", {}))
    except Conflict:
        return


def place_of(key: str) -> Place:
    """The place that a reminder refers to."""
    account, _, robot_type = key.partition(":")[2].partition("/")
    return Place(account, robot_type)
