"""Records the sessions of an agent's devices: sends their rows to the recorder process, and starts uploads."""

import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

from device_agent.config.agent_config import Recording
from device_agent.ports.driver import Driver
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.ports.uploads import RecordingUploads
from device_agent.protocol import Measurements
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.authority.event_recorder import RecordEvent
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.recording.camera_recorder import CameraRecorder, DeviceCameras
from device_agent.runtime.recording.device_recording import DeviceRecording
from device_agent.runtime.recording.folder import RecordingFolder
from device_agent.runtime.recording.messages import Batch, RecorderStatus, RecordingLimits
from device_agent.runtime.recording.recorder_process import RecorderLostError, RecorderProcess
from device_agent.runtime.recording.uploader import RecordingUploader
from device_agent.runtime.room.room_device import RoomDevice
from device_agent.runtime.telemetry.outbox import Outbox

_PERIOD_S = 0.1
_RESTART_S = 1.0
"""Time between the loss of the process and its next start [s]."""
_CLOSE_S = 10.0
_BEHIND_BYTES = 65_536
"""With more unsent messages than this, uploads wait [bytes]."""
_log = logging.getLogger(__name__)


class Recorder:
    """Recordings of one agent. Its thread never ends because of an error, so that no error of it holds a device.

    Args:
        limits: Folder and limits.
        owner: Space and account of the agent; recordings of a former owner are deleted.
        uploader: Uploads sealed segments; ``None``: they stay on this disk.
        cameras: Records cameras; ``None``: they are not recorded.

    Attributes:
        cameras: As above.
    """

    def __init__(
        self,
        limits: RecordingLimits,
        *,
        owner: str,
        uploader: RecordingUploader | None = None,
        cameras: CameraRecorder | None = None,
    ) -> None:
        self.cameras = cameras
        self._folder = RecordingFolder(Path(limits.folder))
        self._owner = owner
        self._ready = False
        # It starts with the first session, or to recover segments after a crash.
        self._process = RecorderProcess(limits)
        self._uploader = uploader
        self._devices: list[DeviceRecording] = []
        self._restart_s = float("-inf")
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run, name="recorder", part="recorder", stopping=self._stopping, recovery=Recovery.RESTART
        )

    def add(self, device: DeviceRecording) -> None:
        """Record this device."""
        self._devices.append(device)
        if self.cameras is not None:
            self.cameras.add_session(device)

    def start(self) -> None:
        """Start to record sessions."""
        self._thread.start()
        if self.cameras is not None:
            self.cameras.start()

    def stop_cameras(self) -> None:
        """Switch the indicator of recorded cameras off, while its device is still connected."""
        if self.cameras is not None:
            self.cameras.stop()

    def stop(self) -> None:
        """Write the rest, seal all segments and end. May be called twice."""
        if self._uploader is not None:
            self._uploader.stop()
        for device in self._devices:
            device.end()
        self._stopping.set()
        self._thread.join(_CLOSE_S)
        self._process.kill()

    def record_reading(self, device: str, stream: str, measured: Measurements) -> None:
        """Record measurements of the room in all present sessions."""
        for each in self._devices:
            each.add_reading(device, stream, measured)

    def _run(self) -> None:
        while not self._stopping.wait(_PERIOD_S):
            self._guarded(self._step)
            if self.cameras is not None:
                self._guarded(self.cameras.update)
        self._guarded(self._step)
        self._guarded(lambda: self._process.close(within_s=_CLOSE_S))

    def _guarded(self, step: Callable[[], None]) -> None:
        try:
            step()
        except Exception:  # noqa: BLE001 (recording must never disturb control)
            _log.exception("recorder")

    def _prepare(self) -> None:
        """Delete recordings of a former owner, recover segments after a crash, and begin to upload.

        Raises:
            OSError: The disk failed or is full.
        """
        self._folder.claim(self._owner)
        self._ready = True
        if self._uploader is not None:
            self._uploader.start()
        if self._folder.live():
            self._exchange(Batch())

    def _step(self) -> None:
        if not self._ready:
            try:
                self._prepare()
            except OSError as error:
                for device in self._devices:
                    device.drop(f"the session is not recorded: {error}")
                return
        if time.monotonic() < self._restart_s:
            return
        for device in self._devices:
            for batch in device.take():
                status = self._exchange(batch)
                if status is None:
                    return
                device.confirm(status)

    def _exchange(self, batch: Batch) -> RecorderStatus | None:
        try:
            status = self._process.exchange(batch)
        except RecorderLostError as error:
            _log.error("%s", error)
            self._restart_s = time.monotonic() + _RESTART_S
            for device in self._devices:
                device.fail(f"the session is not recorded: {error}")
            return None
        if status.deleted:
            for device in self._devices[:1]:
                device.report_deleted(status.deleted)
        return status


def create(
    settings: Recording,
    folder: Path,
    *,
    owner: str,
    uploads: RecordingUploads,
    outbox: Outbox,
    readings: ReadingCache,
    cameras: CameraRecorder,
) -> Recorder | None:
    """The recorder of an agent; ``None`` if ``agent.toml`` disables recordings, or on Windows.

    Args:
        settings: Settings.
        folder: Folder of all recordings.
        owner: Space and account of the agent.
        uploads: The cloud's store.
        outbox: Messages with priority over uploads.
        readings: Measurements of the room, which are recorded, too.
        cameras: Records cameras, with consent.
    """
    if not settings.enabled:
        return None
    if not hasattr(os, "fork"):
        _log.warning("sessions are not recorded: recordings need Linux or macOS")
        return None
    limits = RecordingLimits(
        folder=str(folder),
        max_bytes=round(settings.max_gb * 1e9),
        max_age_s=settings.max_age_days * 86_400,
        min_free_bytes=round(settings.min_free_gb * 1e9),
    )
    uploader = None
    if settings.upload:
        uploader = RecordingUploader(folder, uploads, is_behind=lambda: outbox.stored_bytes > _BEHIND_BYTES)
    recorder = Recorder(limits, owner=owner, uploader=uploader, cameras=cameras)
    readings.listen(recorder.record_reading)
    return recorder


def add_device(
    recorder: Recorder | None,
    address: tuple[str, str],
    robot_type: RobotType,
    driver: Driver | RoomDevice,
    *,
    newest_epoch: Callable[[], int],
    holder: Callable[[int], str],
    record: RecordEvent,
) -> tuple[DeviceRecording | None, DeviceCameras | None]:
    """The recording of a device's sessions, and that of its cameras; ``None`` if there is none.

    Args:
        recorder: The recorder of the agent; ``None``: nothing is recorded.
        address: Agent and name of the device.
        robot_type: Its robot type.
        driver: Its driver.
        newest_epoch: As for ``DeviceRecording``, and so are the following.
        holder: See above.
        record: See above.
    """
    if recorder is None:
        return None, None
    agent, name = address
    recording, cameras = None, robot_type.cameras
    if isinstance(driver, RoomDevice):
        cameras = driver.manifest.cameras
    else:
        recording = DeviceRecording(
            agent, name, robot_type, simulated=driver.simulated, newest_epoch=newest_epoch, holder=holder, record=record
        )
        recorder.add(recording)
    if recorder.cameras is None:
        return recording, None
    return recording, recorder.cameras.add(name, cameras, recording, record)
