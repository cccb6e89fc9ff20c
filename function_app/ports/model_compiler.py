"""Compiles models as a robot's driver will. MuJoCo in a process of its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from device_agent.protocol import Twin
from device_agent.protocol.manifests.robot_type import RobotType


@dataclass(frozen=True, slots=True)
class ModelReport:
    """What a model was found to be.

    Attributes:
        errors: What is wrong, in the compiler's own words with file and line; nothing when all is well.
        warnings: What its author may want to know, and is free to leave as it is.
        twin: The robot as a page draws it, in the frame of its base; ``None`` where it cannot be drawn.
        actuators: Of the model, by name.
        cameras: Of the scene, by name.
    """

    errors: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    twin: Twin | None = None
    actuators: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()


class CompilerMissingError(Exception):
    """Nothing here can compile a model; the text says what to install."""


class ModelCompiler(Protocol):
    """The files may be hostile: they are read by nothing else, and cannot reach anything but themselves."""

    def require(self) -> None:
        """See that it can be used.

        Raises:
            CompilerMissingError: It cannot.
        """

    async def check(
        self, robot_type: RobotType, files: Mapping[str, bytes], missing: Sequence[str] = ()
    ) -> ModelReport:
        """Compile model and scene and compare them with the manifest.

        Args:
            robot_type: What the manifest says.
            files: Name → content.
            missing: Names of files that the model wants and that are not there; the rest is looked at without them.

        Returns:
            What it is. A model that takes too long or too much memory is wrong as well.

        Raises:
            CompilerMissingError: It cannot be used.
        """
