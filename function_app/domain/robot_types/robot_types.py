"""Robot types of an account, as stored in the tables."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

State = Literal["uploading", "checking", "ready", "rejected"]


@dataclass(frozen=True, slots=True)
class Seal:
    """Integrity proof of a stored upload: key id, signature, and SHA-256 of each file (hex)."""

    key: str = ""
    signature: str = ""
    hashes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TypeVersion:
    """One upload of a robot type.

    Attributes:
        state: ``uploading`` until all files are stored, ``checking`` until the validator has finished.
        manifest: Fields of ``RobotType``.
        files: Name → size [bytes].
        errors: Reasons for rejection; before the validation has finished, problems found so far.
        warnings: Notes for the author.
        checked_ms: End of the validation [ms since 1970].
        seal: Integrity proof of manifest and files.
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
        """Whether the validation has not finished."""
        return self.state in {"uploading", "checking"}


@dataclass(frozen=True, slots=True)
class TypeHead:
    """A robot type of an account, and its active version.

    Attributes:
        last: Highest assigned version; versions are never reused.
        since: First version since the last deletion.
        ready: Newest valid version, 0 if there is none; never decreases.
        manifest: Manifest of the ready version.
        seal: Integrity proof of that version.
        ready_ms: When it became ready [ms since 1970].
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
        """Whether a version is or may become active."""
        return not self.deleted and version >= max(self.since, self.ready)


def next_version(head: TypeHead | None, requested: int, robot_type: str) -> TypeHead:
    """The type with one more version: the requested number if it is new."""
    if head is None:
        return TypeHead(robot_type, last=requested, since=requested)
    version = max(head.last + 1, requested)
    if head.deleted:
        return TypeHead(robot_type, last=version, since=version)
    return replace(head, last=version)


def with_ready(head: TypeHead, version: TypeVersion) -> TypeHead:
    """The type after one of its versions became valid; the newest valid version is active."""
    if version.version <= head.ready:
        return head
    return replace(
        head, ready=version.version, manifest=version.manifest, ready_ms=version.checked_ms, seal=version.seal
    )
