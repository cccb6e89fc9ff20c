"""Frames of the decoder process. The agent can end it at any time, and survives its crash."""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from device_agent.ports.sensor import Frame, SensorError
from device_agent.protocol.camera_frames import MAX_CONTENT_BYTES
from device_agent.sensors.camera.decoder import END, HEADER, REASONS
from device_agent.sensors.camera.reader import RejectedError

INTERPRETER = (sys.executable, "-I")
"""This Python, without paths from the environment."""
_PROGRAM = Path(__file__).with_name("decoder.py")
_CRASHED, _TIMEOUT = "crashed", "timeout"


class DecoderSource:
    """A camera that the decoder process reads.

    Args:
        settings: Returns the settings of a new attempt, with the credentials as they are now.
        reasons: Reason of the decoder → message for users; ``crashed``: the process has ended by itself.
    """

    def __init__(self, settings: Callable[[], Mapping[str, Any]], reasons: Mapping[str, str]) -> None:
        self._settings = settings
        self._reasons = reasons
        self._process: subprocess.Popen[bytes] | None = None
        self._aborted = False

    def frames(self) -> Iterator[Frame]:
        """See ``FrameSource``."""
        settings = {**self._settings(), "max_bytes": MAX_CONTENT_BYTES}
        try:
            # Libraries print addresses with passwords to the error output.
            process = subprocess.Popen(  # noqa: S603 (this interpreter and a program of the agent)
                [*INTERPRETER, str(_PROGRAM)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:
            raise SensorError(
                f"the decoder cannot be started: {error.strerror}; check the memory of the machine"
            ) from error
        self._process, self._aborted = process, False
        with process, contextlib.ExitStack() as stack:
            stack.callback(process.kill)
            if process.stdin is None or process.stdout is None:
                raise AssertionError
            with contextlib.suppress(BrokenPipeError):
                # Unbuffered: a rest in the buffer of a process that has ended would fail again in `close`.
                os.write(process.stdin.fileno(), json.dumps(settings).encode() + b"\n")
            yield from self._received(process.stdout)

    def abort(self) -> None:
        """See ``FrameSource``."""
        process = self._process
        if process is not None:
            self._aborted = True
            process.kill()

    def _received(self, output: IO[bytes]) -> Iterator[Frame]:
        while len(header := output.read(HEADER.size)) == HEADER.size:
            kind, taken_s, width, height, length = HEADER.unpack(header)
            content = output.read(min(length, MAX_CONTENT_BYTES))
            if kind == END:
                raise self._error(content.decode("ascii", "replace"))
            if len(content) < length:
                break
            yield Frame(width, height, content, taken_s)
        raise self._error(_TIMEOUT if self._aborted else _CRASHED)

    def _error(self, reason: str) -> SensorError:
        message = self._reasons[reason if reason in REASONS and reason in self._reasons else _CRASHED]
        return RejectedError(message) if reason == "rejected" else SensorError(message)
