"""Records frames of cameras in the sessions of an agent's robots, with the owner's consent and the indicator on.

A robot's camera is recorded in its own sessions; a camera of a room device in those of all robots of the agent. The
cameras' own threads call this. It never waits: frames are dropped rather than delayed.
"""

import threading
import time
from collections.abc import Collection, Mapping, Sequence
from functools import partial

from device_agent.config.agent_config import AgentConfig, Indicator
from device_agent.config.catalogue import room_device_of
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import Pairing
from device_agent.ports.clock import wall_ms
from device_agent.ports.sensor import Frame
from device_agent.protocol import CameraConsent, CameraStream, Fault, SetCameraConsent, camera_frames
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord, RecordEvent
from device_agent.runtime.recording.camera_consent import CameraConsents
from device_agent.runtime.recording.camera_indicator import CameraIndicator
from device_agent.runtime.recording.device_recording import DeviceRecording
from device_agent.runtime.recording.format import FRAMES
from device_agent.runtime.recording.messages import RecordedFrame
from device_agent.runtime.room.room_device import RoomDevice
from device_agent.runtime.storage.journal import Journal

INDICATOR_FAULT = "camera-indicator"
MAX_SHOWN = 64
"""Number of cameras in ``State.recorded_cameras``."""


def create(
    configuration: AgentConfig, journal: Journal, pairing: Pairing, room_devices: Mapping[str, RoomDevice]
) -> "CameraRecorder":
    """The recording of an agent's cameras.

    Args:
        configuration: Settings.
        journal: Stores consents.
        pairing: Agent, space and owner.
        room_devices: Room devices by name, which may still be empty.

    Raises:
        ConfigError: The indicator is no control of a room device, or has other limits.
    """
    settings = configuration.recording
    consents = CameraConsents(journal, space=pairing.space, account=pairing.owner)
    indicator = None
    if settings.indicator is not None:
        _check_indicator(configuration, settings.indicator)
        indicator = CameraIndicator(settings.indicator, room_devices)
    return CameraRecorder(pairing.agent, consents, rate_hz=settings.camera_rate_hz, indicator=indicator)


def _check_indicator(configuration: AgentConfig, indicator: Indicator) -> None:
    entry = next((each for each in configuration.devices if each.name == indicator.device), None)
    described = None if entry is None else room_device_of(entry)
    controls = () if described is None else described.controls
    control = next((each for each in controls if each.name == indicator.control), None)
    if control is None:
        names = ", ".join(each.name for each in controls) or "none"
        raise ConfigError(
            f"[recording.indicator]: '{indicator.device}' is no room device of this agent with the control "
            f"'{indicator.control}'; its controls: {names}"
        )
    limits = f"{control.lower:g} to {control.upper:g}"
    if not all(control.lower <= value <= control.upper for value in (indicator.on, indicator.off)):
        raise ConfigError(f"[recording.indicator]: `on` and `off` of '{indicator.control}' can be {limits}")
    if indicator.on == indicator.off:
        raise ConfigError("[recording.indicator]: `on` and `off` must differ")


class CameraRecorder:
    """Recording of the cameras of one agent.

    Args:
        agent: Id of the agent.
        consents: Decisions of the owner.
        rate_hz: Maximum rate of recorded frames of each camera [Hz].
        indicator: Shows people in the room that cameras are recorded; ``None``: there is no such device.
    """

    def __init__(
        self, agent: str, consents: CameraConsents, *, rate_hz: float, indicator: CameraIndicator | None = None
    ) -> None:
        self.agent = agent
        self.consents = consents
        self.period_s = 1 / rate_hz
        self.indicator = indicator
        self._recordings: list[DeviceRecording] = []
        self._devices: list[DeviceCameras] = []

    def add_session(self, recording: DeviceRecording) -> None:
        """Record cameras of room devices in the sessions of this robot, too."""
        self._recordings.append(recording)

    def add(
        self, name: str, cameras: Sequence[CameraStream], recording: DeviceRecording | None, record: RecordEvent
    ) -> "DeviceCameras | None":
        """Recording of a device's cameras; ``None`` if it has neither sessions nor cameras with colour pictures.

        Args:
            name: Name of the device.
            cameras: Its cameras.
            recording: Its own recording; ``None`` for a room device.
            record: Records its events.
        """
        names = tuple(camera.name for camera in cameras if camera.kind == camera_frames.COLOUR)
        if recording is None and not names:
            return None
        device = DeviceCameras(self, name, names, recording, record)
        self._devices.append(device)
        return device

    def recordings(self, own: DeviceRecording | None) -> Sequence[DeviceRecording]:
        """The recordings that may contain cameras of a device: its own one, or all for a room device."""
        return self._recordings if own is None else (own,)

    def room_cameras(self) -> tuple[str, ...]:
        """Cameras of room devices that may be recorded: ``{device}/{camera}``."""
        return tuple(camera for device in self._devices if device.in_room for camera in device.permitted())

    def start(self) -> None:
        """Start the indicator."""
        if self.indicator is not None:
            self.indicator.start()

    def stop(self) -> None:
        """Switch the indicator off, so that no further frame is recorded. May be called twice."""
        if self.indicator is not None:
            self.indicator.stop()

    def update(self) -> None:
        """Set the indicator and report changes; called periodically by the recorder's thread."""
        if self.indicator is not None:
            self.indicator.require(any(device.waits for device in self._devices))
        for device in self._devices:
            device.report()


class DeviceCameras:
    """Recording of the cameras of one device. Thread-safe."""

    def __init__(
        self,
        recorder: CameraRecorder,
        name: str,
        cameras: Collection[str],
        recording: DeviceRecording | None,
        record: RecordEvent,
    ) -> None:
        self._recorder = recorder
        self._name = name
        self._cameras = cameras
        self._recording = recording
        self._record = record
        self.in_room = recording is None
        self._prefix = f"{recorder.agent}-{name}/" if self.in_room else ""
        self._lock = threading.Lock()
        self._due_s: dict[str, float] = {}
        self._reported: tuple[str, ...] = ()
        recorder.consents.of(name)  # read from the disk now, and not by a camera's thread

    # ------------------------------------------------------------ command processor

    @property
    def consent(self) -> CameraConsent | None:
        """The owner's consent, for ``state``; ``None``: the device has no cameras that can be recorded."""
        return self._recorder.consents.of(self._name) if self._cameras else None

    def decide(self, request: SetCameraConsent, *, caller: str) -> None:
        """Apply a decision of the owner.

        Raises:
            Refused: See ``CameraConsents.decide``.
            JournalError: It cannot be stored.
        """
        if self._recorder.consents.decide(self._name, self._cameras, request, caller=caller):
            names = ", ".join(request.cameras)
            message = f"{caller} allows recording of {names}" if names else f"{caller} allows no camera to be recorded"
            data = {"cameras": list(request.cameras), "caller": caller, "number": request.number}
            self._record(EventRecord(EventKind.CAMERA_CONSENT_CHANGED, message, data=data))

    @property
    def recorded(self) -> tuple[str, ...]:
        """The cameras that are being recorded now, as in ``State.recorded_cameras``."""
        if not any(each.active for each in self._recorder.recordings(self._recording)):
            return ()
        own = self.permitted()
        if not self.in_room:
            return (own + self._recorder.room_cameras())[:MAX_SHOWN]
        return tuple(camera.removeprefix(self._prefix) for camera in own)

    def faults(self) -> tuple[Fault, ...]:
        """Why cameras are not recorded although they should be."""
        indicator = self._recorder.indicator
        if indicator is None or not indicator.error or not self.waits:
            return ()
        message = f"cameras are not recorded, because their indicator in the room failed: {indicator.error}"
        return (Fault(code=INDICATOR_FAULT, message=message[:2000], since_ms=wall_ms()),)

    # ------------------------------------------------------------ cameras' threads

    def is_due(self, camera: str, now_s: float) -> bool:
        """Whether a frame would be recorded that the camera takes now, on the monotonic clock [s]."""
        return self._may_record(camera, now_s) and now_s >= self._due_s.get(camera, now_s)

    def record(self, camera: str, picture: Frame) -> None:
        """Record a frame if there is consent and a session, and if it is due. Never blocks."""
        taken_s = picture.taken_s
        if picture.kind != camera_frames.COLOUR or not self._may_record(camera, taken_s):
            return
        period_s = self._recorder.period_s
        with self._lock:
            due_s = self._due_s.get(camera, taken_s)
            if taken_s < due_s:
                return
            # The average rate is kept although cameras do not take pictures exactly when one is due.
            self._due_s[camera] = max(due_s + period_s, taken_s + period_s / 2)
        age_s = time.monotonic() - taken_s
        frame = RecordedFrame(
            f"{FRAMES}{self._prefix}{camera}", round(taken_s * 1e9), wall_ms() - round(age_s * 1000), picture.content
        )
        is_permitted = partial(self._recorder.consents.permits, self._name, camera, taken_s)
        for recording in self._recorder.recordings(self._recording):
            recording.add_frame(frame, is_permitted)

    def _may_record(self, camera: str, taken_s: float) -> bool:
        """Whether a frame may be recorded that was taken at this time: session, consent and indicator."""
        indicator = self._recorder.indicator
        return (
            any(each.in_session for each in self._recorder.recordings(self._recording))
            and camera in self._cameras
            and self._recorder.consents.permits(self._name, camera, taken_s)
            and (indicator is None or indicator.covers(taken_s))
        )

    # ------------------------------------------------------------ recorder's thread

    @property
    def waits(self) -> bool:
        """Whether there are a session and consent, so that only the indicator may be missing."""
        return bool(self._consented) and any(each.in_session for each in self._recorder.recordings(self._recording))

    def permitted(self) -> tuple[str, ...]:
        """Own cameras with consent while the indicator is on, with the prefix of their topics in the room."""
        indicator = self._recorder.indicator
        if indicator is not None and not indicator.shown:
            return ()
        return tuple(f"{self._prefix}{camera}" for camera in self._consented)

    @property
    def _consented(self) -> list[str]:
        """Own cameras with consent; a camera may have been removed since."""
        return [camera for camera in self._recorder.consents.of(self._name).cameras if camera in self._cameras]

    def report(self) -> None:
        """Record an event if other cameras are recorded than at the last call."""
        recorded = self.recorded
        if recorded == self._reported:
            return
        before, self._reported = self._reported, recorded
        if recorded:
            message, data = f"cameras are being recorded: {', '.join(recorded)}", {"cameras": list(recorded)}
            self._record(EventRecord(EventKind.CAMERAS_RECORDED, message, data=data))
        else:
            message, data = "no cameras are being recorded any more", {"cameras": list(before)}
            self._record(EventRecord(EventKind.CAMERAS_NOT_RECORDED, message, data=data))
