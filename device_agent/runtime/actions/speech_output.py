"""Speech output: publishes the text as an event, and the synthesized audio as an upload."""

import logging
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from device_agent.ports.clock import wall_ms
from device_agent.ports.speech import Speech, SpeechError, Spoken
from device_agent.ports.threads import SupervisedThread
from device_agent.ports.uploads import UploadError, Uploads
from device_agent.protocol import LANGUAGE_PATTERN
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord, RecordEvent
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.visemes import estimate_duration_s

STREAM = "speech"
_UPLOAD_TIMEOUT_S = 2.0
"""If the upload takes longer, the event is published without audio [s]."""
_MAX_DURATION_S = 300.0
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Utterance:
    """A prepared utterance. ``upload`` is the id of its audio once ``stored`` is set, or empty."""

    text: str
    language: str
    duration_s: float
    has_audio: bool = False
    upload: str = ""
    stored: threading.Event = field(default_factory=threading.Event)


class SpeechOutput:
    """Speech of one device. ``on_start`` receives the duration [s] when an utterance starts."""

    def __init__(
        self,
        device: str = "",
        *,
        speech: Speech | None = None,
        uploads: Uploads | None = None,
        record: RecordEvent | None = None,
        on_start: Callable[[float], None] | None = None,
    ) -> None:
        self._device = device
        self._speech = speech
        self._uploads = uploads
        self._record = record
        self._on_start = on_start

    def prepare(self, text: str, language: str) -> Utterance:
        """Synthesize the audio, and start its upload. Takes some tenths of a second.

        Raises:
            Refused: The text is empty, or the language is invalid.
        """
        if not text.strip():
            raise Refused("nothing_to_say", "the text is empty; provide a text")
        if re.fullmatch(LANGUAGE_PATTERN, language) is None:
            raise Refused("bad_language", f"'{language[:40]}' is not a language; use a code such as en or sk, or none")
        spoken = self._synthesize(text, language)
        if spoken is None:
            return Utterance(text, language, estimate_duration_s(text))
        utterance = Utterance(text, language, min(spoken.duration_s, _MAX_DURATION_S), has_audio=True)
        upload = partial(self._upload, utterance, spoken)
        SupervisedThread(upload, name="speech", part="upload of speech", device=self._device).start()
        return utterance

    def start(self, utterance: Utterance) -> None:
        """Publish that an utterance starts; with its audio if the upload finishes in time."""
        if utterance.has_audio:
            utterance.stored.wait(_UPLOAD_TIMEOUT_S)
        data: dict[str, object] = {
            "text": utterance.text,
            "language": utterance.language,
            "duration_s": round(utterance.duration_s, 2),
        }
        if utterance.upload:
            data["upload"] = utterance.upload
        if self._on_start is not None:
            self._on_start(utterance.duration_s)
        if self._record is not None:
            self._record(EventRecord(EventKind.SPEECH_STARTED, utterance.text, data=data))

    def _synthesize(self, text: str, language: str) -> Spoken | None:
        if self._speech is None:
            return None
        try:
            return self._speech.speak(text, language)
        except SpeechError as error:
            _log.warning("%s: %s", self._device, error)
            return None

    def _upload(self, utterance: Utterance, spoken: Spoken) -> None:
        try:
            if self._uploads is not None:
                utterance.upload = self._uploads.store(
                    self._device,
                    stream=STREAM,
                    name=f"{self._device}-speech.wav",
                    media_type="audio/wav",
                    content=spoken.wav,
                    at_ms=wall_ms(),
                )
        except UploadError as error:
            _log.warning("%s: speech: %s", self._device, error)
        finally:
            utterance.stored.set()
