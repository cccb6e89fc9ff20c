"""Compiles models as a robot's driver will. MuJoCo in a process of its own."""

from collections.abc import Mapping
from typing import Protocol

from device_agent.protocol.robot_type import RobotType


class CompilerMissingError(Exception):
    """Nothing here can compile a model; the text says what to install."""


class ModelCompiler(Protocol):
    """The files may be hostile: they are read by nothing else, and cannot reach anything but themselves."""

    def require(self) -> None:
        """See that it can be used.

        Raises:
            CompilerMissingError: It cannot.
        """

    async def check(self, robot_type: RobotType, files: Mapping[str, bytes]) -> tuple[str, ...]:
        """Compile model and scene and compare them with the manifest.

        Returns:
            What is wrong, in the compiler's own words with file and line; nothing when all is well. A model that takes
            too long or too much memory is wrong as well.

        Raises:
            CompilerMissingError: It cannot be used.
        """
