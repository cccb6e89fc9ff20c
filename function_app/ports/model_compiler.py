"""Compiles robot models in a separate process, with the same compiler as the driver (MuJoCo)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from device_agent.protocol import Twin
from device_agent.protocol.manifests.robot_type import RobotType


@dataclass(frozen=True, slots=True)
class ModelReport:
    """The result of compiling a model.

    Attributes:
        errors: Compiler errors with file and line; empty for a valid model.
        warnings: Notes for the author that do not prevent use.
        twin: The geometry for display in the frame of the base; ``None`` if it cannot be drawn.
        actuators: Names of the model's actuators.
        cameras: Names of the scene's cameras.
    """

    errors: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    twin: Twin | None = None
    actuators: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()


class CompilerMissingError(Exception):
    """No model compiler is available; the text says what to install."""


class UnconfinedError(CompilerMissingError):
    """The compiler cannot be confined on this machine; the text names the missing layers and the remedy."""


class ModelCompiler(Protocol):
    """Compiles untrusted model files in a sandbox that reads nothing else. Stateless; safe to retry.

    Example::

        report = await compiler.check(robot_type, files)
    """

    async def require(self) -> None:
        """Check that the compiler is available, and confined.

        Raises:
            CompilerMissingError: It is not available.
        """

    async def check(
        self, robot_type: RobotType, files: Mapping[str, bytes], missing: Sequence[str] = ()
    ) -> ModelReport:
        """Compile model and scene and compare them with the manifest.

        ``files`` maps names to contents. Files that are ``missing`` are referenced but do not exist; the rest is
        checked without them. Exceeding time or memory limits is an error in the report.

        Raises:
            CompilerMissingError: The compiler is not available.
        """
