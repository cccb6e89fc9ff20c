"""Episodes: named parts of a session."""

from pathlib import Path

import msgspec
from msgspec import Struct

from device_agent.cli.export.errors import ExportError

SUCCESS = "success"
"""Outcome of an episode that reached its goal."""


class Episode(Struct, frozen=True, kw_only=True):
    """A part of a session, as marked by the operator.

    Attributes:
        start_s: Start since the start of the session [s].
        end_s: End since the start of the session [s].
        outcome: ``success``, another word, or empty if it was not judged.
        label: What the operator did, for example ``pick the cube``; empty if it has no label.
        note: Remark of the operator.
    """

    start_s: float
    end_s: float
    outcome: str | None = None
    label: str | None = None
    note: str | None = None


def check(episodes: tuple[Episode, ...]) -> tuple[Episode, ...]:
    """The same episodes, in the order of their start.

    Raises:
        ExportError: An episode ends before it starts.
    """
    for episode in episodes:
        if not 0 <= episode.start_s < episode.end_s:
            raise ExportError(f"an episode from {episode.start_s:g} s to {episode.end_s:g} s is not possible")
    return tuple(sorted(episodes, key=lambda episode: episode.start_s))


def load(path: Path) -> tuple[Episode, ...]:
    """The episodes in a JSON file, a list with the fields of ``Episode``.

    Raises:
        ExportError: The file cannot be read, or its content is no such list.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=tuple[Episode, ...])
    except OSError as error:
        raise ExportError(f"{path} cannot be read: {error.strerror}") from error
    except msgspec.MsgspecError as error:
        raise ExportError(f"{path} is not a list of episodes with start_s and end_s: {error}") from error
