"""RTDE, version 2: the binary protocol of Universal Robots' controllers on TCP port 30004.

Source: Universal Robots, *Real-Time Data Exchange (RTDE) Guide*. A package has a header of a 16-bit size, including the
header, and an 8-bit type. All values are big-endian.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum

PROTOCOL_VERSION = 2
HEADER = struct.Struct(">HB")
MAX_SIZE = 4096
"""Maximum size of a valid package [bytes]. A list of names has at most 2,048."""

FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
"""Type of a variable → its format for ``struct``."""
NOT_FOUND, IN_USE = "NOT_FOUND", "IN_USE"


class ProtocolError(Exception):
    """The controller cannot be used: another protocol version, or it lacks a variable."""


class InUseError(Exception):
    """Another client writes an input of the recipe."""


class Package(IntEnum):
    """Types of packages."""

    REQUEST_PROTOCOL_VERSION = ord("V")
    TEXT_MESSAGE = ord("M")
    DATA = ord("U")
    SETUP_OUTPUTS = ord("O")
    SETUP_INPUTS = ord("I")
    START = ord("S")


@dataclass(frozen=True, slots=True)
class Recipe:
    """The variables of one kind of data package.

    Attributes:
        number: Its id at the controller.
        layout: Values of a data package, after the id.
    """

    number: int
    layout: struct.Struct

    def pack(self, values: Sequence[float]) -> bytes:
        """A data package with these values."""
        return package(Package.DATA, bytes([self.number]) + self.layout.pack(*values))

    def unpack(self, payload: bytes) -> tuple[float, ...]:
        """Values of a data package, vectors flattened.

        Raises:
            ValueError: The package has another id or length.
        """
        if len(payload) != 1 + self.layout.size or payload[0] != self.number:
            raise ValueError("a data package does not match its recipe")
        return self.layout.unpack(payload[1:])


def package(kind: int, payload: bytes = b"") -> bytes:
    """One package."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def split(buffer: bytearray) -> Iterator[tuple[int, bytes]]:
    """Remove all complete packages from ``buffer``: types and payloads. It is emptied at an impossible header."""
    while len(buffer) >= HEADER.size:
        size, kind = HEADER.unpack_from(buffer)
        if not HEADER.size <= size <= MAX_SIZE or kind not in _KINDS:
            buffer.clear()
            return
        if len(buffer) < size:
            return
        payload = bytes(buffer[HEADER.size : size])
        del buffer[:size]
        yield kind, payload


class Setup:
    """Sets up a connection.

    Args:
        request: Sends a package and returns the response of the same type. Its exceptions are passed on.
    """

    def __init__(self, request: Callable[[int, bytes], bytes]) -> None:
        self._request = request

    def check_version(self) -> None:
        """Select the protocol version.

        Raises:
            ProtocolError: The controller does not support it.
        """
        response = self._request(Package.REQUEST_PROTOCOL_VERSION, struct.pack(">H", PROTOCOL_VERSION))
        if response != b"\x01":
            raise ProtocolError(f"the controller does not support RTDE version {PROTOCOL_VERSION}; update its software")

    def outputs(self, variables: Sequence[tuple[str, str]], frequency_hz: float) -> Recipe:
        """The recipe of the packages that the controller sends; variables are pairs of name and type.

        Raises:
            ProtocolError: The controller lacks a variable.
        """
        names = ",".join(name for name, _ in variables).encode()
        return _recipe(variables, self._request(Package.SETUP_OUTPUTS, struct.pack(">d", frequency_hz) + names))

    def inputs(self, variables: Sequence[tuple[str, str]]) -> Recipe:
        """The recipe of packages that the controller receives.

        Raises:
            ProtocolError: The controller lacks a variable.
            InUseError: Another client writes one of them.
        """
        names = ",".join(name for name, _ in variables).encode()
        return _recipe(variables, self._request(Package.SETUP_INPUTS, names))

    def start(self) -> None:
        """Let the controller send data packages.

        Raises:
            ProtocolError: It refuses.
        """
        if self._request(Package.START, b"") != b"\x01":
            raise ProtocolError("the controller refuses to send data; restart it")


def _recipe(variables: Sequence[tuple[str, str]], response: bytes) -> Recipe:
    types = response[1:].decode("ascii", "replace").split(",")
    if len(types) != len(variables):
        raise ProtocolError("the controller's response to a recipe is invalid")
    for (name, expected), found in zip(variables, types, strict=True):
        if found == IN_USE:
            raise InUseError(name)
        if found != expected:
            problem = "does not have" if found == NOT_FOUND else f"has another type ({found}) for"
            raise ProtocolError(f"the controller {problem} the variable '{name}'; update its software")
    return Recipe(response[0], struct.Struct(">" + "".join(FORMATS[kind] for _, kind in variables)))


_KINDS = frozenset(Package)
