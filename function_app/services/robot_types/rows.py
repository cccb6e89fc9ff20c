"""The rows of an account's robot types, and the notes of those who look after them.

Each type has a partition and a blob prefix of its own. In ``ModelChecks``, partition ``checks`` holds what a checker
has to compile, partition ``looks`` when a type needs to be looked at: whatever a stop of some process has left half
done is brought to its end then.
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
LOOKED = "looked.json"
"""Beside a version's files: what its checker has found (``Looked``). No uploaded file has such a name."""
TRIALS = "type-look:"
_TRIAL = "~"


@dataclass(frozen=True, slots=True)
class Place:
    """Where a robot type of an account is."""

    account: str
    type: str

    @property
    def trial(self) -> bool:
        """Whether it is a look at an upload that is not saved: no robot type has such an id."""
        return self.type.startswith(_TRIAL)

    @property
    def partition(self) -> str:
        """Of its rows."""
        return f"{self.account}/{self.type}"

    def prefix(self, version: int) -> str:
        """Of the blobs of one version."""
        return f"robot-types/{self.account}/{self.type}/{version}/"


def place(caller: Identity, robot_type: str) -> Place | None:
    """Where the type is, or ``None`` where the text cannot be one."""
    return Place(caller.account, robot_type) if ID.match(robot_type) else None


def preview_place(caller: Identity, look: str) -> Place | None:
    """Where a look at an upload is: like a robot type, where nobody finds it who asks for robot types."""
    return Place(caller.account, _TRIAL + look) if ID.match(look) else None


def preview_index(where: Place) -> str:
    """Of the row that lists a look for its account."""
    return TRIALS + where.type.removeprefix(_TRIAL)


def version_key(version: int) -> str:
    """Of a version's row."""
    return f"{VERSIONS}{version:08d}"


async def read_head(tables: Tables, where: Place) -> tuple[Row | None, TypeHead | None]:
    """The row that decides, and what it says."""
    row = await tables.get(records.ROBOT_TYPES, where.partition, HEAD)
    return row, None if row is None else records.read(row, TypeHead)


async def read_version(tables: Tables, where: Place, version: int) -> tuple[Row | None, TypeVersion | None]:
    """One upload."""
    row = await tables.get(records.ROBOT_TYPES, where.partition, version_key(version))
    return row, None if row is None else records.read(row, TypeVersion)


async def schedule_check(tables: Tables, where: Place, due_ms: int) -> None:
    """See that the type is looked at when ``due_ms`` has come; the same note twice is one."""
    try:
        await tables.create(records.MODEL_CHECKS, Row(LOOKS, f"{due_ms:013d}:{where.partition}", {}))
    except Conflict:
        return


def place_of(key: str) -> Place:
    """Whose type a look's note is about."""
    account, _, robot_type = key.partition(":")[2].partition("/")
    return Place(account, robot_type)
