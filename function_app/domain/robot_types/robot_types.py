"""Robot types of an account, as the tables hold them."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

State = Literal["uploading", "checking", "ready", "rejected"]


@dataclass(frozen=True, slots=True)
class Seal:
    """That what is stored is what was uploaded: a key's id, its signature, and each file's hash (SHA-256, hex)."""

    key: str = ""
    signature: str = ""
    hashes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TypeVersion:
    """One upload of a robot type.

    Attributes:
        state: ``uploading`` until all files are stored, ``checking`` until a checker has a verdict.
        manifest: The fields of ``RobotType``.
        files: Name → bytes.
        errors: Why it is refused; until there is a verdict what was found before it.
        warnings: What its author may want to know.
        checked_ms: When the verdict came [ms since 1970].
        seal: On manifest and files.
    """

    version: int
    state: State
    manifest: dict[str, Any]
    files: dict[str, int]
    created_ms: int
    errors: tuple[str, ...] = ()
    checked_ms: int = 0
    seal: Seal = field(default_factory=Seal)
    warnings: tuple[str, ...] = ()

    @property
    def open(self) -> bool:
        """Whether a verdict is still to come."""
        return self.state in {"uploading", "checking"}


@dataclass(frozen=True, slots=True)
class TypeHead:
    """A robot type of an account: which of its versions is in use.

    Attributes:
        last: The highest version ever given; none is given twice.
        since: The first version since it was last made new.
        ready: The newest version that is ready, 0 when none is; it never goes back.
        manifest: Of the version that is ready, and
        seal: what says so.
        ready_ms: When that became ready [ms since 1970].
    """

    type: str
    last: int = 0
    since: int = 1
    ready: int = 0
    manifest: dict[str, Any] = field(default_factory=dict)
    ready_ms: int = 0
    deleted: bool = False
    seal: Seal = field(default_factory=Seal)

    def needs(self, version: int) -> bool:
        """Whether a version may still be used, or become so."""
        return not self.deleted and version >= max(self.since, self.ready)


def next_version(head: TypeHead | None, wanted: int, robot_type: str) -> TypeHead:
    """The type with one version more: the one its author calls it, where that is new."""
    if head is None:
        return TypeHead(robot_type, last=wanted, since=wanted)
    version = max(head.last + 1, wanted)
    if head.deleted:
        return TypeHead(robot_type, last=version, since=version)
    return replace(head, last=version)


def with_ready(head: TypeHead, version: TypeVersion) -> TypeHead:
    """The type after one of its versions was found good; the newest good one counts."""
    if version.version <= head.ready:
        return head
    return replace(
        head, ready=version.version, manifest=version.manifest, ready_ms=version.checked_ms, seal=version.seal
    )
