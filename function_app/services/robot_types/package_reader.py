"""Reads the files of an uploaded robot type and checks their names, sizes and references."""

import base64
import binascii
import contextlib
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TypeVar
from xml.parsers import expat

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import robot_type as manifests
from device_agent.protocol.manifests.robot_type import RobotType
from function_app.domain.common.ids import ID
from function_app.domain.common.problems import Problem, invalid

MAX_FILES = 32
MAX_BYTES = 6_000_000
"""Maximum size of all files [bytes]."""
MAX_MANIFEST = 48_000
MAX_VERSION = 1_000_000
MAX_REPORTED = 20
"""Maximum number of reported errors."""
TEXT = ".xml"
BINARY = (".stl", ".obj", ".png")
_NAME = re.compile(r"\A(?=.{1,120}\Z)([A-Za-z0-9_-][A-Za-z0-9_.-]*/){0,3}[A-Za-z0-9_-][A-Za-z0-9_.-]*\.[a-z]{3}\Z")
_FILE = re.compile(r"\Afile", re.IGNORECASE)
_FOLDERS = frozenset({"meshdir", "texturedir", "assetdir"})
T = TypeVar("T")
_OUTSIDE = re.compile(r"\A[/~]|[\\:\x00]|(\A|/)\.\.(/|\Z)")


@dataclass(frozen=True, slots=True)
class Upload:
    """An uploaded robot type; ``files`` includes the manifest."""

    robot_type: RobotType
    files: dict[str, bytes]


def read_upload(manifest: str, files: Mapping[str, str]) -> Upload:
    """Check everything that does not need MuJoCo.

    Args:
        manifest: Text of ``robot.toml``.
        files: Name → text of an ``.xml`` file; base64 of other files.

    Raises:
        Problem: ``manifest-invalid`` with the field, ``robot-type-invalid`` with the file; the first error, with all
            errors in ``errors``.
    """
    if not 1 <= len(files) <= MAX_FILES:
        raise _bad(f"A robot type has 1 to {MAX_FILES} files, not {len(files)}.")
    problems: list[Problem] = []
    robot_type = _or_record_error(problems, partial(_manifest, manifest))
    content: dict[str, bytes] = {}
    for name, text in files.items():
        read = _or_record_error(problems, partial(_content, name, text))
        if read is not None:
            content[name] = read
    problems += _content_errors(content)
    if robot_type is not None:
        problems += _reference_errors(robot_type, content)
    for name, file_content in content.items():
        if name.endswith(TEXT):
            _or_record_error(problems, partial(_check_references, name, file_content))
    if problems or robot_type is None:
        errors = [problem.detail for problem in problems][:MAX_REPORTED]
        raise invalid(errors[0], code=problems[0].code, errors=errors)
    return Upload(robot_type, {manifests.MANIFEST: manifest.encode(), **content})


def missing(files: Mapping[str, bytes]) -> tuple[tuple[str, str, int], ...]:
    """Referenced files that are not in the upload: the referring file, the name and the line."""
    existing = {name.rpartition("/")[2] for name in files}
    result: list[tuple[str, str, int]] = []

    def watch_references(name: str, parser: expat.XMLParserType) -> None:
        def element(_: str, attributes: dict[str, str]) -> None:
            for attribute, value in attributes.items():
                file_name = value.rpartition("/")[2]
                if _FILE.match(attribute) and file_name and file_name not in existing:
                    result.append((name, file_name, parser.CurrentLineNumber))

        parser.StartElementHandler = element

    for name, text in files.items():
        if name.endswith(TEXT):
            parser = _parser()
            watch_references(name, parser)
            with contextlib.suppress(expat.ExpatError):
                parser.Parse(text, True)
    return tuple(result)


def malformed(files: Mapping[str, bytes]) -> tuple[str, ...]:
    """Files that are not well-formed XML, whose references cannot be checked."""
    errors = []
    for name, text in files.items():
        if name.endswith(TEXT):
            try:
                _parser().Parse(text, True)
            except expat.ExpatError as error:
                errors.append(f"{name}: {error}.")
    return tuple(errors)


def _content_errors(content: Mapping[str, bytes]) -> Iterator[Problem]:
    if sum(map(len, content.values())) > MAX_BYTES:
        yield _bad(f"All files together have at most {MAX_BYTES} bytes. Simplify the meshes.")
    for name in content:
        folder = next((other for other in content if name.startswith(other + "/")), None)
        if folder is not None:
            yield _bad(f"'{folder}' cannot be a file and a folder.")


def _reference_errors(robot_type: RobotType, content: Mapping[str, bytes]) -> Iterator[Problem]:
    for field in ("model", "scene"):
        file_name = getattr(robot_type, field)
        if file_name not in content or not file_name.endswith(TEXT):
            existing = _xml_names(content)
            yield _bad_manifest(f"{field} is '{file_name[:120]}'; it must be one of the .xml files: {existing}.")


def _or_record_error(problems: list[Problem], read: Callable[[], T]) -> T | None:
    """The result of ``read``, or ``None`` after recording its error."""
    try:
        return read()
    except Problem as problem:
        problems.append(problem)
        return None


def _manifest(text: str) -> RobotType:
    if len(text.encode()) > MAX_MANIFEST:
        raise _bad_manifest(f"It has at most {MAX_MANIFEST} bytes.")
    try:
        result = manifests.parse(text)
    except (ProtocolError, RecursionError) as error:
        raise _bad_manifest(f"{error}.") from error
    if not ID.match(result.type):
        raise _bad_manifest("type consists of 1 to 64 letters, digits, _ and -.")
    if not 1 <= result.version <= MAX_VERSION:
        raise _bad_manifest(f"version is {result.version}; it must be 1 to {MAX_VERSION}.")
    return result


def _content(name: str, text: str) -> bytes:
    if not _NAME.match(name) or not name.endswith((TEXT, *BINARY)):
        endings = ", ".join((TEXT, *BINARY))
        raise _bad(f"File name '{name[:120]}' is not valid: use letters, digits, _, - and ., then one of {endings}.")
    if name.endswith(TEXT):
        return text.encode()
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise _bad(f"'{name}' is not base64: {error}.") from error


def _check_references(name: str, text: bytes) -> None:
    """Reject references outside the folder. MuJoCo reports malformed XML."""
    outside: list[str] = []

    def element(tag: str, attributes: dict[str, str]) -> None:
        for attribute, value in attributes.items():
            if (_FILE.match(attribute) or attribute.lower() in _FOLDERS) and _OUTSIDE.search(value):
                outside.append(f'{name}: <{tag} {attribute}="{value[:120]}"> leads out of the robot type\'s folder.')

    def doctype(*_: object) -> None:
        outside.append(f"{name}: a DOCTYPE is not allowed.")

    parser = _parser()
    parser.StartElementHandler = element
    parser.StartDoctypeDeclHandler = doctype
    with contextlib.suppress(expat.ExpatError):
        parser.Parse(text, True)
    if outside:
        raise _bad(" ".join(outside[:5]))


def _parser() -> expat.XMLParserType:
    """A parser that decodes UTF-8 like MuJoCo, regardless of the XML declaration."""
    return expat.ParserCreate("utf-8")


def _xml_names(files: Mapping[str, bytes]) -> str:
    return ", ".join(sorted(name for name in files if name.endswith(TEXT))) or "there is none"


def _bad(detail: str) -> Problem:
    return invalid(detail, code="robot-type-invalid")


def _bad_manifest(detail: str) -> Problem:
    return invalid(f"robot.toml: {detail}", code="manifest-invalid")
