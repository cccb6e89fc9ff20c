"""``python -I -B …/device_agent/sandbox/__main__.py CONTROL``: the zygote; CONTROL is the number of its socket."""

import sys
from pathlib import Path


def _start() -> None:
    # ``-I`` excludes the folder from the path: add it for this import only.
    root = str(Path(__file__).resolve().parents[2])
    sys.path.append(root)
    from device_agent.sandbox import zygote  # noqa: PLC0415 (not before the path is set)

    sys.path.remove(root)
    zygote.main(int(sys.argv[1]))


_start()
