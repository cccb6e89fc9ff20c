"""Write ``drawing.json`` for each built-in robot type, from which the console draws it without a device.

Run ``python robots/draw.py`` after changing a model or manifest; ``--check`` reports outdated files.
"""  # noqa: INP001 - a script, not a package

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
    """The drawing of a robot type, from the model compiler."""
    files = {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.suffix in _MODEL_FILES
    }
    result = asyncio.run(MujocoCompiler().check(robot_type.load(folder), files))
    if result.errors:
        raise SystemExit("\n".join(result.errors))
    return msgspec.json.encode(result) + b"\n"


def main() -> int:
    """Write all drawings, or check them; returns the exit code."""
    outdated = 0
    for folder in sorted(path.parent for path in Path(__file__).parent.glob(f"*/{robot_type.MANIFEST}")):
        content, file = drawing(folder), folder / DRAWING
        if not file.is_file() or file.read_bytes() != content:
            outdated += 1
            if "--check" in sys.argv:
                print(f"{file} is outdated; run python robots/draw.py")  # noqa: T201
            else:
                file.write_bytes(content)
    return int("--check" in sys.argv and outdated > 0)


if __name__ == "__main__":
    sys.exit(main())
