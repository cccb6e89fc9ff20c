"""What turns text into sound. This page is the implementer's manual."""

from dataclasses import dataclass
from typing import Protocol


class SpeechError(Exception):
    """Nothing can be spoken now. Its text is fit for an operator."""


@dataclass(frozen=True, slots=True)
class Spoken:
    """One text as sound.

    Attributes:
        wav: The file, whole.
        duration_s: How long it is [s].
    """

    wav: bytes
    duration_s: float


class Speech(Protocol):
    """A speaker's voice. Thread-safe."""

    def speak(self, text: str, language: str) -> Spoken | None:
        """Make sound of a text. Called in the thread of an action; takes some tenths of a second.

        Args:
            text: At most 2,000 characters, of whatever kind.
            language: As ``en`` or ``sk``; empty, or one that it does not know: its own.

        Returns:
            ``None`` where this machine has no voice: the text is all there is.

        Raises:
            SpeechError: It has one, and that failed.
        """
