"""``python -I -B …/device_agent/sandbox/__main__.py CONTROL``: the warm parent; CONTROL is the number of its socket."""

import sys
from pathlib import Path


def _start() -> None:
    # ``-I`` keeps the folder and the environment out of the path, so this package is put in, and out again.
    root = str(Path(__file__).resolve().parents[2])
    sys.path.append(root)
    from device_agent.sandbox import zygote  # noqa: PLC0415 (not before the path is set)

    sys.path.remove(root)
    zygote.main(int(sys.argv[1]))


_start()
