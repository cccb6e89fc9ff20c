"""Robot types from the folders under ``robots/``."""

import ast
import hashlib
from collections.abc import Mapping
from pathlib import Path

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import robot_type as manifest
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.topics import is_id
from function_app.ports.robot_catalogue import BuiltInMovement
from function_app.ports.tables import StoreError

DRAWING = "drawing.json"
"""File in each type's folder, created by ``python -m robots.draw``."""
_SUFFIXES = frozenset({".toml", ".xml", ".stl", ".obj", ".png", ".md", ".py"})


class FolderCatalogue:
    """``RobotCatalogue`` of ``folder``: one robot type in each folder that has a manifest."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._types: dict[str, RobotType] | None = None
        self._files: dict[str, dict[str, bytes]] = {}
        self._movements: dict[str, dict[str, BuiltInMovement]] = {}

    async def types(self) -> Mapping[str, RobotType]:
        if self._types is None:
            try:
                folders = sorted(path.parent for path in self._folder.glob(f"*/{manifest.MANIFEST}"))
                self._types = {folder.name: manifest.load(folder) for folder in folders}
            except (OSError, ProtocolError) as error:
                raise StoreError(str(error)) from error
        return self._types

    async def files(self, robot_type: str) -> Mapping[str, bytes]:
        if robot_type not in await self.types():
            return {}
        if robot_type not in self._files:
            folder = self._folder / robot_type
            paths = [path for path in sorted(folder.rglob("*")) if path.suffix in _SUFFIXES and path.is_file()]
            try:
                self._files[robot_type] = {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
            except OSError as error:
                raise StoreError(str(error)) from error
        return self._files[robot_type]

    async def movements(self, robot_type: str) -> Mapping[str, BuiltInMovement]:
        robot = (await self.types()).get(robot_type)
        if robot is None:
            return {}
        if robot_type not in self._movements:
            scripts = sorted((self._folder / robot_type / manifest.MOVEMENTS).glob("*.py"))
            self._movements[robot_type] = {path.stem: _read(path, robot.version) for path in scripts}
        return self._movements[robot_type]

    async def drawing(self, robot_type: str) -> bytes | None:
        if robot_type not in await self.types():
            return None
        try:
            return (self._folder / robot_type / DRAWING).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise StoreError(str(error)) from error


def _read(path: Path, version: int) -> BuiltInMovement:
    try:
        source = path.read_text(encoding="utf-8")
        docstring = ast.get_docstring(ast.parse(source)) or ""
    except (OSError, ValueError, SyntaxError) as error:
        raise StoreError(f"{path}: {error}") from error
    if not is_id(path.stem):
        raise StoreError(f"{path}: a movement's name has 1 to 64 letters, digits, _ and -")
    return BuiltInMovement(
        name=path.stem,
        description=docstring.partition("\n")[0],
        version=version,
        sha256=hashlib.sha256(source.encode()).hexdigest(),
        updated_ms=int(path.stat().st_mtime * 1000),
        source=source,
    )
