"""One device at work: puts its control loop, office, executor and voice together, and routes what arrives.

Two threads a device: the control loop (``loop``), which never waits for disk or network, and the ``office``, which
does; a third, the ``reporter``, where its driver measures more than joints; a fourth, the ``filmer``, where it has
cameras. Setpoints and Stop go from the transport's
thread straight into the controller.
"""

import logging
import time
from collections.abc import Callable, Sequence

from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.ports.driver import Driver, HasCameras, HasSpeaker, ReportsStreams
from device_agent.ports.floor_map import ObstacleMap
from device_agent.ports.geometry import RobotGeometry
from device_agent.ports.sandbox import Sandbox
from device_agent.ports.skills import Skills
from device_agent.ports.speech import Speech
from device_agent.ports.uploads import Uploads
from device_agent.protocol import JointTelemetry, Measurements, Setpoint, Stop, StopLatch, codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.events import EventKind
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.executor import ActionExecutor
from device_agent.runtime.actions.script_policy import ScriptPolicy
from device_agent.runtime.actions.speech_output import SpeechOutput
from device_agent.runtime.authority.event_recorder import EventRecord, EventRecorder
from device_agent.runtime.authority.interlocks import Interlocks
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.commands.command_processor import CommandProcessor
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.control.control_loop import ControlLoop
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.room.room_device import RoomDevice
from device_agent.runtime.room.sensor_loop import SensorLoop
from device_agent.runtime.storage.journal import Journal
from device_agent.runtime.telemetry.camera_streamer import CameraStreamer
from device_agent.runtime.telemetry.device_publisher import DevicePublisher
from device_agent.runtime.telemetry.outbox import Outbox, Publish
from device_agent.runtime.telemetry.stream_sampler import StreamSampler

_REFUSED = {
    topics.CTL: EventKind.SETPOINTS_REJECTED,
    topics.STOP: EventKind.STOP_REJECTED,
    topics.CMD: EventKind.COMMAND_REJECTED,
}
_SCRIPTS = {"unavailable": EventKind.SCRIPTS_UNAVAILABLE, "unconfined": EventKind.SCRIPTS_UNCONFINED}
_log = logging.getLogger(__name__)


class Device:
    """One device of an agent.

    Args:
        name: Its name at the agent, a level of its topics.
        label: Its name for people.
        space: Id of the space.
        agent: Id of the agent.
        robot_type: Joints, limits, period.
        driver: Not yet connected; an ``RoomDevice`` for a device of a room.
        journal: Open.
        cloud_clock: For ``ttl_ms``.
        keys: The cloud's keys, as far as they are pinned.
        publish: Sends a message.
        outbox: Sends what must not be lost.
        room: What the space's other devices have measured last.
        interlocks: How the room slows or holds this one.
        jail: Where movement scripts run.
        owner: Id of the account that the agent is paired with.
        geometry: The robot's shape, ``None`` where its type has no model.
        ground: What stands in its room, while somebody sees that.
        speech: The machine's voice, if it has one.
        uploads: Where sounds go.
    """

    def __init__(
        self,
        *,
        name: str,
        label: str,
        space: str,
        agent: str,
        robot_type: RobotType,
        driver: Driver | RoomDevice,
        journal: Journal,
        cloud_clock: CloudClock,
        keys: PinnedKeys,
        publish: Publish,
        outbox: Outbox,
        room: ReadingCache,
        jail: Sandbox,
        owner: str = "",
        interlocks: Sequence[InterlockRule] = (),
        geometry: RobotGeometry | None = None,
        ground: Callable[[], ObstacleMap | None] | None = None,
        speech: Speech | None = None,
        uploads: Uploads | None = None,
    ) -> None:
        self.name = name
        self._driver = driver
        self._jail = jail
        record = journal.device(name)
        gate = LeaseGate(epoch=record.epoch, burned=record.epoch)  # a restart ends whatever lease there was
        self._audit = EventRecorder()
        self._controller = Controller(robot_type, gate, latch=record.latch, geometry=geometry, tell=self._audit.note)
        self._controller.changed.set()
        instrument = driver if isinstance(driver, RoomDevice) else None
        self._reporter = StreamSampler(
            robot_type.streams, driver if isinstance(driver, ReportsStreams) else None, name=name, tell=self._measured
        )
        body = DeviceContext(
            robot_type=robot_type,
            controller=self._controller,
            observe=lambda: self._loop.seen,
            geometry=geometry,
            skills=driver if isinstance(driver, Skills) else None,
            room=room,
            reported=self._reporter.latest,
            instrument=instrument,
            name=name,
            ground=ground,
            hurry=self._hurry,
            speaker=SpeechOutput(
                name,
                speech=speech,
                uploads=uploads,
                tell=self._audit.note,
                heard=driver.speaks if isinstance(driver, HasSpeaker) else None,
            ),
        )
        self.voice = DevicePublisher(
            address=(space, agent, name),
            label=label,
            robot_type=robot_type,
            room_device=None if instrument is None else instrument.manifest,
            simulated=driver.simulated,
            limits=self._controller.limits if robot_type.joints else (),
            actions=body.tasks() if instrument is None else instrument.actions,
            interlocks=[rule.description for rule in interlocks],
            journal=journal,
            publish=publish,
            outbox=outbox,
        )
        self._filmer = CameraStreamer(
            robot_type.cameras,
            driver if isinstance(driver, HasCameras) else None,
            name=name,
            film=self.voice.film,
            controlled=lambda: self._controller.lease(time.monotonic()) is not None,
        )
        self._room = room
        self._interlocks = Interlocks(
            interlocks,
            room,
            restrict=self._controller.restrict,
            lift=self._controller.lift,
            note=lambda happened, code, now_s: self._audit.refused(happened, code=code, now_s=now_s),
        )
        self._loop = self._loop_of(driver, robot_type)
        trust = ScriptPolicy(device=name, robot_type=robot_type.type, owner=owner, keys=keys, journal=journal)
        self._executor = ActionExecutor(body, trust=trust, jail=jail, report=self.voice.report, settle=journal.settle)
        self._office = CommandProcessor(
            address=(space, agent, name),
            controller=self._controller,
            executor=self._executor,
            voice=self.voice,
            audit=self._audit,
            journal=journal,
            cloud_clock=cloud_clock,
            keys=keys,
            hurry=self._hurry,
            ailing=tuple if instrument is None else instrument.vigil.faults,
        )

    def _loop_of(self, driver: Driver | RoomDevice, robot_type: RobotType) -> ControlLoop | SensorLoop:
        watch = self._interlocks.step
        if isinstance(driver, RoomDevice):
            return SensorLoop(
                driver, self._controller, name=self.name, tell=self._measured, film=self.voice.film, watch=watch
            )
        return ControlLoop(
            robot_type,
            driver,
            self._controller,
            name=self.name,
            tell=lambda telemetry: self._measured(topics.JOINTS, telemetry),
            watch=watch,
        )

    # ------------------------------------------------------------ life

    def start(self) -> None:
        """Connect the driver and begin to hold.

        Raises:
            DriverError: The device is not there.
        """
        self._loop.start()
        self._reporter.start()
        self._filmer.start()
        epoch, _ = self._controller.epochs
        data = {"epoch": epoch, "stopped": self._controller.latch is not None}
        self._audit.note(
            EventRecord(EventKind.AGENT_STARTED, "the agent started; leases of before have ended", data=data)
        )
        self.voice.scripts = scripts = self._jail.standing()
        if scripts.how != "sandboxed":
            self._audit.note(EventRecord(_SCRIPTS[scripts.how], scripts.why, "warning", {"reason": scripts.why}))
        self._office.start(None if isinstance(self._driver, RoomDevice) else self._driver.twin())

    def stop(self) -> None:
        """End what runs, hold, and let the driver go. May be called twice."""
        self._controller.lost(Refused("agent_stopping", "the agent was shut down"))
        self._executor.close()
        self._loop.stop()
        self._reporter.stop()
        self._filmer.stop()
        self._audit.note(EventRecord(EventKind.AGENT_STOPPED, "the agent was shut down"))
        self._office.stop()
        self._driver.close()

    @property
    def quiet(self) -> bool:
        """Whether nothing would be disturbed by a short break of the link."""
        return not self._controller.moving and self._executor.current() is None

    def _measured(self, stream: str, telemetry: JointTelemetry | Measurements) -> None:
        self._room.note(self.name, stream, telemetry)
        self.voice.tell(stream, telemetry)

    # ------------------------------------------------------------ what arrives (transport's thread)

    def receive(self, topic: topics.Topic, payload: bytes) -> None:
        """Take in one message; quick, and never raises."""
        try:
            if topic.kind == topics.CTL:
                self._take_setpoint(topic.name, payload)
            elif topic.kind == topics.STOP:
                stop = codec.decode(payload, Stop)
                self._controller.stop(StopLatch(caller=stop.caller, reason=stop.reason, at_ms=wall_ms()))
                self._hurry()
                _log.warning("%s: stopped by %s", self.name, stop.caller)
            elif topic.kind == topics.CMD:
                self._office.put(payload)
        except Refused as refused:
            self._refuse(topic.kind, refused.code, refused.message)
        except ProtocolError as error:
            _log.warning("%s: %s refused: %s", self.name, topic.kind, str(error)[:300])
            self._refuse(topic.kind, "malformed", str(error)[:300])

    def _refuse(self, topic_kind: str, code: str, message: str) -> None:
        self.voice.count(code)
        kind = _REFUSED[topic_kind]
        self._audit.refused(EventRecord(kind, message, "warning", {"code": code}), code=code, now_s=time.monotonic())

    def _take_setpoint(self, epoch: str, payload: bytes) -> None:
        setpoint = codec.decode(payload, Setpoint)
        if epoch != str(setpoint.epoch):
            raise Refused("no_lease", "the epoch in the topic and in the message differ")
        self._controller.offer(setpoint, now_s=time.monotonic(), tick_ms=tick_ms())
        self._hurry()

    def _hurry(self) -> None:
        """What was asked does not wait for the next period."""
        self._loop.hurry()

    def link_changed(self, up: bool) -> None:
        """The link came or went."""
        self._filmer.link_changed(up)
        if up:
            self._office.introduce()
        else:
            self._controller.lost(Refused("link_lost", "the device lost its link"))
