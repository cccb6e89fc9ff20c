"""What a device says: as text that everybody can see, and as sound where the machine has a voice."""

import logging
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from device_agent.ports.clock import wall_ms
from device_agent.ports.speech import Speech, SpeechError, Spoken
from device_agent.ports.uploads import UploadError, Uploads
from device_agent.protocol import LANGUAGE_PATTERN
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.visemes import estimate_duration_s

STREAM = "speech"
_UPLOAD_WITHIN_S = 2.0
"""Longer nobody waits for the sound: the text then goes alone, and the robot speaks."""
_MOST_S = 300.0
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Utterance:
    """Something that is ready to be said.

    Attributes:
        text: The words; ``language``: as they were asked for.
        duration_s: How long it takes [s].
        sound: Whether there is any.
        upload: Id of the sound in the cloud, once ``stored``.
    """

    text: str
    language: str
    duration_s: float
    sound: bool = False
    upload: str = ""
    stored: threading.Event = field(default_factory=threading.Event)


class SpeechOutput:
    """Who says what one device is to say.

    Args:
        device: Its name.
        speech: The machine's voice; ``None``: none.
        uploads: Where sounds go, for pages to fetch; ``None``: nowhere.
        tell: Called with what is said, when it begins.
        heard: Called with how long that is [s], at the same time.
    """

    def __init__(
        self,
        device: str = "",
        *,
        speech: Speech | None = None,
        uploads: Uploads | None = None,
        tell: Callable[[EventRecord], None] | None = None,
        heard: Callable[[float], None] | None = None,
    ) -> None:
        self._device = device
        self._speech = speech
        self._uploads = uploads
        self._tell = tell
        self._heard = heard

    def prepare(self, text: str, language: str) -> Utterance:
        """Make the sound, and begin to store it. Takes some tenths of a second.

        Raises:
            Refused: There is nothing to say, or no such language.
        """
        if not text.strip():
            raise Refused("nothing_to_say", "there is nothing to say; give a text")
        if re.fullmatch(LANGUAGE_PATTERN, language) is None:
            raise Refused("bad_language", f"'{language[:40]}' is no language; give one as en, sk, or none")
        spoken = self._spoken(text, language)
        if spoken is None:
            return Utterance(text, language, estimate_duration_s(text))
        utterance = Utterance(text, language, min(spoken.duration_s, _MOST_S), sound=True)
        threading.Thread(target=self._store, args=(utterance, spoken), name="speech", daemon=True).start()
        return utterance

    def begin(self, utterance: Utterance) -> None:
        """Tell that it is said from now on; with its sound, if that is stored in time."""
        if utterance.sound:
            utterance.stored.wait(_UPLOAD_WITHIN_S)
        data: dict[str, object] = {
            "text": utterance.text,
            "language": utterance.language,
            "duration_s": round(utterance.duration_s, 2),
        }
        if utterance.upload:
            data["upload"] = utterance.upload
        if self._heard is not None:
            self._heard(utterance.duration_s)
        if self._tell is not None:
            self._tell(EventRecord(EventKind.SPEECH_STARTED, utterance.text, data=data))

    def _spoken(self, text: str, language: str) -> Spoken | None:
        if self._speech is None:
            return None
        try:
            return self._speech.speak(text, language)
        except SpeechError as error:
            _log.warning("%s: %s", self._device, error)
            return None

    def _store(self, utterance: Utterance, spoken: Spoken) -> None:
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
