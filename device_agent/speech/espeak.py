"""Speech synthesis by ``espeak-ng``, if installed; works offline."""

import io
import shutil
import subprocess
import wave

from device_agent.ports.speech import SpeechError, Spoken

PROGRAM = "espeak-ng"
_TIMEOUT_S = 20.0
_HEADER_BYTES = 44
_OWN_LANGUAGE = "en"


class Espeak:
    """``Speech`` that starts ``espeak-ng`` for each text."""

    def speak(self, text: str, language: str) -> Spoken | None:
        """See ``Speech``."""
        program = shutil.which(PROGRAM)
        if program is None:
            return None
        for voice in dict.fromkeys((language or _OWN_LANGUAGE, _OWN_LANGUAGE)):
            # Pass the text on standard input, so that it cannot be parsed as an option.
            command = [program, "--stdin", "--stdout", "-v", voice.lower()]
            try:
                result = subprocess.run(  # noqa: S603 (a fixed program; the language is letters, digits and hyphens)
                    command, input=text.encode(errors="replace"), capture_output=True, timeout=_TIMEOUT_S, check=False
                )
            except (OSError, subprocess.TimeoutExpired) as error:
                raise SpeechError(f"{PROGRAM} failed: {error}") from error
            if result.returncode == 0 and len(result.stdout) > _HEADER_BYTES:
                return _with_header(result.stdout)
        raise SpeechError(f"{PROGRAM} failed: {result.stderr.decode(errors='replace').strip()[:300]}")


def _with_header(stream: bytes) -> Spoken:
    """A WAV file with a correct length in its header; the streamed header has none."""
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
