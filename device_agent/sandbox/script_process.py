"""The process of one script, from the fork to its end: speaks to the agent, compiles and runs the script.

A JSON object per line each way. To the agent: ``ready`` once the jail holds, calls, ``output``, ``progress``, at last
``ended``; from it: the script, then one answer to each call. Nothing in here is a boundary: a script may change every
word of it. What holds is around the process, and what the agent believes of the lines that come out.
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

_PIECE = 65_536
_OUTPUT_KEPT = 8_000
"""Characters of output that wait to be sent; of more the newest, since the agent keeps fewer."""
_OUTPUT_EVERY_S = 0.02


class Link:
    """Lines of JSON over the only socket."""

    def __init__(self) -> None:
        self._rest = b""

    def read(self) -> dict[str, Any]:
        """The next message; the process ends when the agent has gone."""
        pieces = [self._rest]
        while b"\n" not in pieces[-1]:
            piece = os.read(confinement.LINK, _PIECE)
            if not piece:
                os._exit(1)
            pieces.append(piece)
        line, _, self._rest = b"".join(pieces).partition(b"\n")
        message: dict[str, Any] = json.loads(line)
        return message

    def tell(self, kind: str, **arguments: Any) -> None:
        """One message; a number that is not finite is an error here, in the script's own line."""
        line = json.dumps({"kind": kind, **arguments}, allow_nan=False).encode() + b"\n"
        while line:
            line = line[os.write(confinement.LINK, line) :]


class Output(io.TextIOBase):
    """Where a script prints to: the operator's page."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._waiting = ""
        self._sent_s = float("-inf")

    def write(self, text: str) -> int:
        """Send what was printed, whole lines, and not every one by itself."""
        self._waiting = (self._waiting + text)[-_OUTPUT_KEPT:]
        if "\n" in text and time.monotonic() - self._sent_s >= _OUTPUT_EVERY_S:
            self.flush()
        return len(text)

    def flush(self) -> None:
        """Send what waits."""
        if self._waiting:
            text, self._waiting = self._waiting, ""
            self._link.tell("output", text=text)
            self._sent_s = time.monotonic()

    def writable(self) -> bool:
        """Yes."""
        return True


def prepare() -> None:
    """What a forked process must not share with its brothers: random numbers (``random`` sees to its own)."""
    if (numpy := sys.modules.get("numpy")) is not None:
        numpy.random.seed()


def give_up(reason: str) -> None:
    """Tell the agent that the jail does not hold; the script is then never sent."""
    with suppress(OSError):
        Link().tell("unfit", reason=reason[:1000])


def main() -> None:
    """Run the script that the agent sends, and end this process."""
    link = Link()
    link.tell("ready")
    task = link.read()
    filename = f"{task['name']}.py"
    output = Output(link)
    sys.stdout = sys.stderr = output

    def ask(kind: str, **arguments: Any) -> Any:
        output.flush()
        link.tell(kind, **arguments)
        answer = link.read()
        if "error" in answer:
            raise api.RobotError(answer["error"])
        return answer.get("value")

    given = {"__name__": "__movement__", **api.names(link.tell, ask, output.flush, task)}
    error = ""
    try:
        exec(compile(task["source"], filename, "exec"), given)  # noqa: S102 (the purpose of this process)  # nosec B102
    except BaseException as raised:  # noqa: BLE001 (whatever a script raises is an answer, not a crash)
        error = _explain(raised, filename)
    output.flush()
    link.tell("ended", error=error[:2000])
    os._exit(0)


def _explain(error: BaseException, filename: str) -> str:
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    if isinstance(error, SyntaxError) and error.filename == filename:
        return f"line {error.lineno}: {text}"
    lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == filename]
    return f"line {lines[-1]}: {text}" if lines else text
