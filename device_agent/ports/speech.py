"""Port: speech synthesizer. The implementer's manual."""

from dataclasses import dataclass
from typing import Protocol


class SpeechError(Exception):
    """Synthesis failed. The message is shown to operators."""


@dataclass(frozen=True, slots=True)
class Spoken:
    """Synthesized speech.

    Attributes:
        wav: The complete file.
        duration_s: Duration [s].
    """

    wav: bytes
    duration_s: float


class Speech(Protocol):
    """Speech synthesizer. Thread-safe."""

    def speak(self, text: str, language: str) -> Spoken | None:
        """Synthesize a text. Called in the thread of an action; takes some tenths of a second.

        Args:
            text: At most 2,000 arbitrary characters.
            language: ``en``, ``sk`` …; the default voice if empty or unknown.

        Returns:
            ``None`` if this machine has no synthesizer; speech is then text only.

        Raises:
            SpeechError: Synthesis failed.
        """
