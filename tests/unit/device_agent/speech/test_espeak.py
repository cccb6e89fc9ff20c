"""The voice of a machine: a real program, or none."""

import io
import wave
from pathlib import Path

import pytest

from device_agent.ports.speech import SpeechError
from device_agent.speech import Espeak


def test_a_text_becomes_a_wav_file() -> None:
    short, long = (Espeak().speak(text, "en") for text in ("Hello.", "Hello, I am a robot, and I can speak for long."))
    assert short is not None
    assert long is not None
    with wave.open(io.BytesIO(long.wav)) as file:
        assert file.getnframes() / file.getframerate() == pytest.approx(long.duration_s, abs=1e-3)
    assert 0.2 < short.duration_s < long.duration_s < 10


@pytest.mark.parametrize(
    ("text", "language"),
    [("Dobrý deň", "sk"), ("Hello", "xx-YY")]
    + [(text, "") for text in ("--help", "-f /etc/passwd", "a\x00b", "<speak>", "\U0001f916", "\ud83e")],
)
def test_any_text_in_any_language_is_spoken_and_never_an_option(text: str, language: str) -> None:
    spoken = Espeak().speak(f"{text} and so on", language)
    assert spoken is not None
    assert spoken.wav.startswith(b"RIFF")


def test_without_espeak_nothing_is_synthesized(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert Espeak().speak("hello", "") is None


@pytest.mark.parametrize("does", ["exit 1", "exec sleep 60"])
def test_a_failing_synthesizer_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, does: str) -> None:
    program = tmp_path / "espeak-ng"
    program.write_text(f"#!/bin/sh\n{does}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    monkeypatch.setattr("device_agent.speech.espeak._TIMEOUT_S", 0.2 if "sleep" in does else 5.0)
    with pytest.raises(SpeechError, match="failed"):
        Espeak().speak("hello", "")
