"""Write what pages need to show each built-in robot type without a robot: ``drawing.json`` in its folder.

``python robots/draw.py`` after a model or manifest has changed; ``--check`` says whether one has.
"""  # noqa: INP001 - a script beside the folders it draws, not a package

import asyncio
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import msgspec

from device_agent.protocol.manifests import robot_type
from function_app.adapters.local.robot_catalogue import DRAWING
from function_app.adapters.model_compiler.compiler import MujocoCompiler

_MODEL_FILES = frozenset({".xml", ".stl", ".obj", ".png"})


def drawing(folder: Path) -> bytes:
    """What the checker finds in a folder's model."""
    files = {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.suffix in _MODEL_FILES
    }
    looked = asyncio.run(MujocoCompiler().check(robot_type.load(folder), files))
    if looked.errors:
        raise SystemExit("\n".join(looked.errors))
    return msgspec.json.encode(looked) + b"\n"


def main() -> int:
    """Write all, or tell which are old; the exit code says whether there were any."""
    old = 0
    for folder in sorted(path.parent for path in Path(__file__).parent.glob(f"*/{robot_type.MANIFEST}")):
        made, file = drawing(folder), folder / DRAWING
        if not file.is_file() or file.read_bytes() != made:
            old += 1
            if "--check" in sys.argv:
                print(f"{file} is old: python robots/draw.py")  # noqa: T201
            else:
                file.write_bytes(made)
    return int("--check" in sys.argv and old > 0)


if __name__ == "__main__":
    sys.exit(main())
