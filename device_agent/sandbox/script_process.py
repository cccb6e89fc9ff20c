"""The process of one script, from fork to exit: communicates with the agent, compiles and runs the script.

Each message is one line of JSON. It sends ``ready`` once confined, then calls, ``output``, ``progress`` and finally
``ended``; it receives the script, then one response per call. This module is not a security boundary: a script can
change all of it. The boundaries are the confinement, and the agent's strict parsing of the lines.
"""

import io
import json
import os
import sys
import time
import traceback
from contextlib import suppress
from typing import Any

from device_agent.sandbox import api, confinement

_CHUNK_BYTES = 65_536
_MAX_OUTPUT = 8_000
"""Buffered characters of output; the oldest are dropped, since the agent stores fewer."""
_OUTPUT_INTERVAL_S = 0.02


class Link:
    """Lines of JSON over the only socket."""

    def __init__(self) -> None:
        self._rest = b""

    def read(self) -> dict[str, Any]:
        """The next message. Exits if the agent has ended."""
        chunks = [self._rest]
        while b"\n" not in chunks[-1]:
            chunk = os.read(confinement.LINK, _CHUNK_BYTES)
            if not chunk:
                os._exit(1)
            chunks.append(chunk)
        line, _, self._rest = b"".join(chunks).partition(b"\n")
        message: dict[str, Any] = json.loads(line)
        return message

    def send(self, kind: str, **arguments: Any) -> None:
        """Send one message. A number that is not finite raises here, at the script's own line."""
        line = json.dumps({"kind": kind, **arguments}, allow_nan=False).encode() + b"\n"
        while line:
            line = line[os.write(confinement.LINK, line) :]


class Output(io.TextIOBase):
    """Standard output of the script, shown in the operator's console."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._buffer = ""
        self._sent_s = float("-inf")

    def write(self, text: str) -> int:
        """Buffer text; sends complete lines at a limited rate."""
        self._buffer = (self._buffer + text)[-_MAX_OUTPUT:]
        if "\n" in text and time.monotonic() - self._sent_s >= _OUTPUT_INTERVAL_S:
            self.flush()
        return len(text)

    def flush(self) -> None:
        """Send the buffered text."""
        if self._buffer:
            text, self._buffer = self._buffer, ""
            self._link.send("output", text=text)
            self._sent_s = time.monotonic()

    def writable(self) -> bool:
        """Always true."""
        return True


def prepare() -> None:
    """Reseed NumPy's random numbers, which forked processes would share; ``random`` reseeds itself."""
    if (numpy := sys.modules.get("numpy")) is not None:
        numpy.random.seed()


def report_unfit(reason: str) -> None:
    """Report that the process could not be confined; the agent then sends no script."""
    with suppress(OSError):
        Link().send("unfit", reason=reason[:1000])


def main() -> None:
    """Run the script that the agent sends, and exit."""
    link = Link()
    link.send("ready")
    task = link.read()
    filename = f"{task['name']}.py"
    output = Output(link)
    sys.stdout = sys.stderr = output

    def call(kind: str, **arguments: Any) -> Any:
        output.flush()
        link.send(kind, **arguments)
        response = link.read()
        if "error" in response:
            raise api.RobotError(response["error"])
        return response.get("value")

    namespace = {"__name__": "__movement__", **api.namespace(link.send, call, output.flush, task)}
    error = ""
    try:
        exec(compile(task["source"], filename, "exec"), namespace)  # noqa: S102 (the purpose of this process)  # nosec B102
    except BaseException as raised:  # noqa: BLE001 (an exception of the script is a result, not a crash)
        error = _explain(raised, filename)
    output.flush()
    link.send("ended", error=error[:2000])
    os._exit(0)


def _explain(error: BaseException, filename: str) -> str:
    text = _without_class_names(str(error))
    if not isinstance(error, api.RobotError):
        text = f"{type(error).__name__}: {text}" if text else type(error).__name__
    if isinstance(error, SyntaxError) and error.filename == filename:
        return f"line {error.lineno}: {text}"
    lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == filename]
    return f"line {lines[-1]}: {text}" if lines else text


def _without_class_names(message: str) -> str:
    """Python's messages name the class of an object; a script only knows ``robot`` and ``room``."""
    for kind in (api.Robot, api.Room):
        name = kind.__name__
        message = message.replace(f"'{name}' object", name.lower()).replace(f"{name}.", f"{name.lower()}.")
    return message
