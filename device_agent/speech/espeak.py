"""``espeak-ng``, where the machine has it: a small voice in a hundred languages, without a network."""

import io
import shutil
import subprocess
import wave

from device_agent.ports.speech import SpeechError, Spoken

PROGRAM = "espeak-ng"
_WITHIN_S = 20.0
_HEADER_BYTES = 44
_OWN_LANGUAGE = "en"


class Espeak:
    """``Speech`` by a program, started for each text."""

    def speak(self, text: str, language: str) -> Spoken | None:
        """See ``Speech``."""
        program = shutil.which(PROGRAM)
        if program is None:
            return None
        for voice in dict.fromkeys((language or _OWN_LANGUAGE, _OWN_LANGUAGE)):
            # The text goes by standard input: none of it can be taken for an option.
            command = [program, "--stdin", "--stdout", "-v", voice.lower()]
            try:
                done = subprocess.run(  # noqa: S603 (a fixed program; the language is letters, digits and hyphens)
                    command, input=text.encode(errors="replace"), capture_output=True, timeout=_WITHIN_S, check=False
                )
            except (OSError, subprocess.TimeoutExpired) as error:
                raise SpeechError(f"{PROGRAM} did not speak: {error}") from error
            if done.returncode == 0 and len(done.stdout) > _HEADER_BYTES:
                return _whole(done.stdout)
        raise SpeechError(f"{PROGRAM} did not speak: {done.stderr.decode(errors='replace').strip()[:300]}")


def _whole(stream: bytes) -> Spoken:
    """A file from what a stream began with and has: its header names no true length."""
    rate_hz = int.from_bytes(stream[24:28], "little")
    samples = stream[_HEADER_BYTES:]
    samples = samples[: len(samples) // 2 * 2]
    file = io.BytesIO()
    with wave.open(file, "wb") as writer:
        writer.setnchannels(1)
        writer.setsampwidth(2)
        writer.setframerate(rate_hz)
        writer.writeframes(samples)
    return Spoken(file.getvalue(), len(samples) / 2 / rate_hz)
