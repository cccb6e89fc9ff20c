"""Rows of an account's robot types, and the reminders for validation and cleanup.

Each type has its own partition and blob prefix. In ``ModelChecks``, partition ``checks`` contains validation jobs by
account, oldest first. Partition ``looks`` contains cleanup reminders, which also complete interrupted operations.
Partition ``validators`` has a row while the validator that started last cannot confine its compiler.
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
VALIDATORS = "validators"
INDEX = "type:"
REPORT = "looked.json"
"""Name of the stored ``ModelReport`` of a version. No uploaded file can have this name."""
PREVIEWS = "type-look:"
_PREVIEW = "~"


@dataclass(frozen=True, slots=True)
class Refusal:
    """The reason of a validator that does not check models."""

    reason: str


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


async def add_job(tables: Tables, where: Place, version: int, now_ms: int) -> None:
    """Create a validation job."""
    key = f"{where.account}/{now_ms:013d}:{where.type}:{version}"
    await tables.create(records.MODEL_CHECKS, Row(CHECKS, key, {"version": version, "until_ms": 0, "tries": 0}))


def job_target(job: Row) -> tuple[Place, int]:
    """The place and version that a job validates."""
    account, _, rest = job.key.partition("/")
    robot_type, _, version = rest.partition(":")[2].rpartition(":")
    return Place(account, robot_type), int(version)


def after_account(job: Row) -> str:
    """The least key after all jobs of the account of this job."""
    return job.key.partition("/")[0] + chr(ord("/") + 1)


async def record_refusal(tables: Tables, reason: str) -> None:
    """Record why the validator does not check models; empty: it does."""
    refusal = Refusal(reason)
    if reason:
        await records.upsert(tables, records.MODEL_CHECKS, VALIDATORS, "refusal", lambda _: refusal, Refusal)
    else:
        await records.remove(tables, records.MODEL_CHECKS, VALIDATORS, "refusal")


async def read_refusal(tables: Tables) -> str:
    """Why the validator does not check models; empty if there is no such reason."""
    _, refusal = await records.find(tables, records.MODEL_CHECKS, VALIDATORS, "refusal", Refusal)
    return "" if refusal is None else refusal.reason


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
