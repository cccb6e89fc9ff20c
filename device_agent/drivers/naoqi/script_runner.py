"""Runs one program of the robot's owner for the bridge, until it ends or the bridge closes this program's input.

It imports nothing of the agent. Arguments: interpreter, program, and ``host:port`` of NAOqi. It prints why the program
failed, or nothing.
"""

from __future__ import annotations

import collections
import os
import select
import signal
import subprocess
import sys
import threading

_CHECK_S = 0.02
_END_S = 1.0
_MAX_TEXT = 500
_INHERITED = ("PATH", "HOME", "LANG", "LD_LIBRARY_PATH", "PYTHONPATH")
"""The agent's variables that the program receives. Others may contain secrets."""


def run(python: str, program: str, address: str) -> str:
    """Run the program in a process group of its own, and kill all of it at the end; returns its error."""
    host, _, port = address.partition(":")
    environment = {name: os.environ[name] for name in _INHERITED if name in os.environ}
    environment.update(NAO_IP=host, NAO_PORT=port, NAOQI_URL="tcp://" + address)
    try:
        process = subprocess.Popen(  # noqa: S603 (the owner permits the programs of this folder)
            [python, program],
            env=environment,
            cwd=os.path.dirname(program),  # noqa: PTH120 (as everywhere here: older Python)
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
    except OSError as error:
        return f"the script cannot be started: {error}"
    tail: collections.deque[bytes] = collections.deque(maxlen=1)
    reader = threading.Thread(target=tail.extend, args=(process.stderr,), daemon=True)
    reader.start()
    while process.poll() is None and not select.select([sys.stdin], [], [], _CHECK_S)[0]:
        pass
    code = process.poll()
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        code = code or 0  # all processes have ended
    process.wait()
    reader.join(_END_S)
    last = b"".join(tail).decode(errors="replace").strip()[:_MAX_TEXT]
    return f"the script failed with exit code {code}: {last}" if code else ""


if __name__ == "__main__":
    for ending in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(ending, signal.SIG_IGN)  # the bridge ends it
    sys.stdout.write(run(*sys.argv[1:4]))
    sys.stdout.flush()
    os._exit(0)
