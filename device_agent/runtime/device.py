"""One device: wires its control loop, command processor, action executor and publisher, and routes its messages.

Threads: the control loop (``loop``), which never waits for disk or network, and the command processor (``commands``),
which may. A driver with streams besides joints adds ``stream``, and one with cameras adds ``camera``. Setpoints and
Stop go from the transport's thread straight to the controller.
"""

import logging
import time
from collections.abc import Callable, Sequence
from functools import partial

from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.ports.driver import Driver, HasCameras, HasSpeaker, ReportsStreams
from device_agent.ports.floor_map import ObstacleMap
from device_agent.ports.geometry import RobotGeometry
from device_agent.ports.sandbox import Sandbox
from device_agent.ports.skills import HasBehaviours, HasControls, Skills
from device_agent.ports.speech import Speech
from device_agent.ports.threads import SupervisedThread
from device_agent.ports.tracing import CommandTraces, NoTraces
from device_agent.ports.uploads import Uploads
from device_agent.protocol import JointTelemetry, Measurements, Setpoint, Stop, StopLatch, codec, topics
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.events import EventKind
from device_agent.protocol.fields import printable
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.security import setpoints
from device_agent.protocol.state import unverified
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.executor import ActionExecutor
from device_agent.runtime.actions.script_policy import ScriptPolicy
from device_agent.runtime.actions.speech_output import SpeechOutput
from device_agent.runtime.actions.task_monitors import TaskMonitors
from device_agent.runtime.authority.event_recorder import EventRecord, EventRecorder
from device_agent.runtime.authority.interlocks import Interlocks
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.commands.command_processor import COMMAND_PROCESSOR, CommandProcessor
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.control.command_arbiter import ControlOutput
from device_agent.runtime.control.control_loop import CONTROL_LOOP, REST_RAD_S, ControlLoop
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused
from device_agent.runtime.load import LoadGovernor
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.recording.recorder import Recorder, add_device
from device_agent.runtime.room.room_device import RoomDevice
from device_agent.runtime.room.sensor_loop import SENSOR_LOOP, SensorLoop
from device_agent.runtime.storage.journal import Journal, JournalError
from device_agent.runtime.supervision import Failure, PartFaults, Supervisor
from device_agent.runtime.telemetry.activity_meter import ActivityMeter
from device_agent.runtime.telemetry.camera_streamer import CameraStreamer
from device_agent.runtime.telemetry.device_publisher import DevicePublisher
from device_agent.runtime.telemetry.outbox import Outbox, Publish
from device_agent.runtime.telemetry.stream_sampler import StreamSampler

_REJECTED = {
    topics.CTL: EventKind.SETPOINTS_REJECTED,
    topics.STOP: EventKind.STOP_REJECTED,
    topics.CMD: EventKind.COMMAND_REJECTED,
}
_SCRIPTS = {"unavailable": EventKind.SCRIPTS_UNAVAILABLE, "unconfined": EventKind.SCRIPTS_UNCONFINED}
MAX_REASON = 2000
_log = logging.getLogger(__name__)


class Device:
    """One device of an agent."""

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
        readings: ReadingCache,
        sandbox: Sandbox,
        owner: str = "",
        interlocks: Sequence[InterlockRule] = (),
        geometry: RobotGeometry | None = None,
        obstacle_map: Callable[[], ObstacleMap | None] | None = None,
        speech: Speech | None = None,
        uploads: Uploads | None = None,
        load: LoadGovernor | None = None,
        supervisor: Supervisor | None = None,
        traces: CommandTraces | None = None,
        streaming: bool = True,
        recorder: Recorder | None = None,
        task_monitors: TaskMonitors | None = None,
    ) -> None:
        self.name = name
        self._sync = journal.sync
        self._load = load or LoadGovernor()
        self._driver = driver
        self._sandbox = sandbox
        supervisor, traces = supervisor or Supervisor(), traces or NoTraces()
        supervisor.add(self)
        self._part_faults = PartFaults(supervisor)
        self._readings = readings
        room_device = driver if isinstance(driver, RoomDevice) else None
        if room_device is not None:
            room_device.load = self._load
        record = journal.device(name)
        gate = LeaseGate(epoch=record.epoch, burned=record.epoch)  # a restart ends every lease
        self._events = EventRecorder()
        self._controller = Controller(
            robot_type, gate, latch=record.latch, geometry=geometry, record=self._events.record
        )
        self._controller.changed.set()
        self._stream_sampler = StreamSampler(
            robot_type.streams,
            driver if isinstance(driver, ReportsStreams) else None,
            name=name,
            publish=self._publish,
            load=self._load,
        )
        context = DeviceContext(
            robot_type=robot_type,
            controller=self._controller,
            observe=lambda: self._loop.observation,
            geometry=geometry,
            skills=driver if isinstance(driver, Skills) else None,
            behaviours=driver if isinstance(driver, HasBehaviours) else None,
            controls=driver if isinstance(driver, HasControls) else None,
            task_monitors=task_monitors or TaskMonitors(),
            readings=readings,
            own_readings=self._stream_sampler.latest,
            room_device=room_device,
            name=name,
            obstacle_map=obstacle_map,
            wake=self._wake,
            speech=SpeechOutput(
                name,
                speech=speech,
                uploads=uploads,
                record=self._events.record,
                on_start=driver.start_speech if isinstance(driver, HasSpeaker) else None,
            ),
        )
        self._recording, self._cameras = add_device(
            recorder,
            (agent, name),
            robot_type,
            driver,
            newest_epoch=lambda: self._controller.epochs[0],
            holder=self._holder,
            record=self._events.record,
        )
        self.publisher = DevicePublisher(
            address=(space, agent, name),
            label=label,
            robot_type=robot_type,
            room_device=None if room_device is None else room_device.manifest,
            simulated=driver.simulated,
            limits=self._controller.limits if robot_type.joints else (),
            actions=context.tasks() if room_device is None else room_device.actions,
            robot_behaviours=context.robot_behaviours,
            controls=driver.controls if isinstance(driver, HasControls) else (),
            interlocks=[rule.description for rule in interlocks],
            streaming=streaming,
            journal=journal,
            publish=publish,
            outbox=outbox,
            traces=traces,
            record_event=self._recording.add_event if self._recording else None,
        )
        self._camera_streamer = CameraStreamer(
            robot_type.cameras,
            driver if isinstance(driver, HasCameras) else None,
            name=name,
            publish=self.publisher.publish_frame,
            is_controlled=lambda: self._controller.lease(time.monotonic()) is not None,
            load=self._load,
            recording=self._cameras,
        )
        self._interlocks = Interlocks(
            interlocks,
            readings,
            restrict=self._controller.restrict,
            lift=self._controller.lift,
            record=lambda event, code, now_s: self._events.record_rejection(event, code=code, now_s=now_s),
        )
        self._activity = ActivityMeter(self._events.record)
        self._loop = self._create_loop(driver, robot_type)
        policy = ScriptPolicy(device=name, robot_type=robot_type.type, owner=owner, keys=keys, journal=journal)
        self._executor = ActionExecutor(
            context, policy=policy, sandbox=sandbox, report=self.publisher.report, sync=journal.sync
        )
        self._commands = CommandProcessor(
            address=(space, agent, name),
            controller=self._controller,
            executor=self._executor,
            publisher=self.publisher,
            events=self._events,
            journal=journal,
            cloud_clock=cloud_clock,
            keys=keys,
            wake=self._wake,
            part_faults=self._part_faults.present,
            device_faults=self._loop.faults,
            recording=self._recording,
            cameras=self._cameras,
            load=self._load,
            traces=traces,
        )

    def _create_loop(self, driver: Driver | RoomDevice, robot_type: RobotType) -> ControlLoop | SensorLoop:
        if isinstance(driver, RoomDevice):
            return SensorLoop(
                driver,
                self._controller,
                name=self.name,
                publish=self._publish,
                publish_frame=self.publisher.publish_frame,
                check_interlocks=self._interlocks.update,
                record_frame=self._cameras.record if self._cameras else None,
            )
        return ControlLoop(
            robot_type,
            driver,
            self._controller,
            name=self.name,
            publish=lambda telemetry: self._publish(topics.JOINTS, telemetry),
            check_interlocks=self._interlocks.update,
            measure=self._measure,
            load=self._load,
            record=self._recording.record_period if self._recording else None,
        )

    def _holder(self, epoch: int) -> str:
        lease = self._controller.lease(time.monotonic())
        return lease.holder if lease is not None and lease.epoch == epoch else self._executor.caller

    def _measure(self, now_s: float, output: ControlOutput, moving: bool) -> None:
        # A lease that was granted since this period began has not moved the robot.
        epoch = output.epoch or self._controller.epochs[0]
        self._activity.record_period(now_s, epoch=epoch, mode=output.mode, moving=moving)

    # ------------------------------------------------------------ start and stop

    def start(self) -> None:
        """Connect the driver, and hold the present position.

        Raises:
            DriverError: The device does not respond.
        """
        self._loop.start()
        self._stream_sampler.start()
        self._camera_streamer.start()
        data = {"epoch": self._controller.epochs[0], "stopped": self._controller.latch is not None}
        message = "the agent started; all previous leases have ended"
        self._events.record(EventRecord(EventKind.AGENT_STARTED, message, data=data))
        self.publisher.scripts = scripts = self._sandbox.status()
        if scripts.mode in _SCRIPTS:
            kind = _SCRIPTS[scripts.mode]
            self._events.record(EventRecord(kind, scripts.reason, "warning", {"reason": scripts.reason}))
        self._commands.start(None if isinstance(self._driver, RoomDevice) else self._driver.twin())

    def stop(self) -> None:
        """End the running action, hold, and close the driver. May be called twice."""
        self._controller.interrupt(Refused("agent_stopping", "the agent was shut down"))
        self._executor.close()
        self._loop.stop()
        self._activity.report(time.monotonic())
        self._stream_sampler.stop()
        self._camera_streamer.stop()
        self._events.record(EventRecord(EventKind.AGENT_STOPPED, "the agent was shut down"))
        self._commands.stop()
        self._driver.close()

    # ------------------------------------------------------------ failures of threads (supervisor's thread)

    def part_failed(self, failure: Failure) -> None:
        """Hold and report, because a thread has ended or hangs."""
        self._part_faults.add(failure)
        if not failure.lasts:
            self._part_faults.remove(failure)
        self._events.record(EventRecord(EventKind.PART_FAILED, failure.message, "error", {"part": failure.part}))
        # In a separate thread: a driver or thread that hangs must not block the supervisor.
        hold = partial(self._hold_after, failure)
        SupervisedThread(hold, name=f"{self.name}-hold", part="hold after a failure", device=self.name).start()

    def _hold_after(self, failure: Failure) -> None:
        if failure.part in {CONTROL_LOOP, SENSOR_LOOP}:
            self._loop.fail(failure.message)
        else:
            self._controller.hold(Refused("fault", failure.message))
        if failure.part == COMMAND_PROCESSOR:
            self._commands.report_failure()

    def part_recovered(self, failure: Failure) -> None:
        """Report that a failure is over. The operator must take control again."""
        self._part_faults.remove(failure)
        message = f"the failure of the {failure.part} is over"
        self._events.record(EventRecord(EventKind.PART_RECOVERED, message, data={"part": failure.part}))

    @property
    def quiet(self) -> bool:
        """Whether the device neither moves nor runs an action."""
        return not self._controller.moving and self._executor.current() is None

    def suspend(self, why: str) -> str:
        """Reject grants, actions and motion with the reason ``why`` until ``resume``; Stop still latches.

        Returns:
            What prevents it, or an empty string: no lease is in force, nothing moves and the journal is on disk.
        """
        reason = self._controller.suspend(why, time.monotonic())
        if reason:
            return reason
        try:
            self._sync()
        except JournalError as error:
            reason = str(error)
        if not self._executor.idle:
            reason = "an action ends"
        elif self._moves():
            reason = "a joint moves"
        if reason:
            self._controller.resume()
        return reason

    def resume(self) -> None:
        """Allow grants, actions and motion again."""
        self._controller.resume()

    def _moves(self) -> bool:
        """Whether the device is measured in motion. The last measurement of a failed device is no evidence."""
        observation = self._loop.observation
        if observation is None or self._controller.fault is not None:
            return False
        return any(abs(velocity) > REST_RAD_S for velocity in observation.velocity_rad_s)

    def _publish(self, stream: str, telemetry: JointTelemetry | Measurements) -> None:
        self._readings.record(self.name, stream, telemetry)
        self.publisher.publish_telemetry(stream, telemetry)
        if self._recording is not None and isinstance(telemetry, Measurements):
            self._recording.add_measurements(stream, telemetry)

    # ------------------------------------------------------------ received messages (transport's thread)

    def receive(self, topic: topics.Topic, payload: bytes) -> None:
        """Handle one message; quick, and never raises."""
        try:
            if topic.kind == topics.CTL:
                self._accept_setpoint(topic, payload)
            elif topic.kind == topics.STOP:
                self._stop(topic.name, codec.decode(payload, Stop))
            elif topic.kind == topics.CMD:
                self._commands.submit(payload)
        except Refused as refused:
            self._reject(topic.kind, refused.code, refused.message)
        except SignatureError as error:
            self._reject(topic.kind, "bad_signature", str(error))
        except ProtocolError as error:
            _log.warning("%s: %s rejected: %s", self.name, topic.kind, str(error)[:300])
            self._reject(topic.kind, "malformed", str(error)[:300])

    def _reject(self, topic_kind: str, code: str, message: str) -> None:
        self.publisher.count_rejection(code)
        event = EventRecord(_REJECTED[topic_kind], message, "warning", {"code": code})
        self._events.record_rejection(event, code=code, now_s=time.monotonic())

    def _stop(self, author: str, stop: Stop) -> None:
        """Latch Stop. Only the broker vouches for the author, so it is shown as unverified."""
        latch = StopLatch(caller=unverified(author), reason=printable(stop.reason[:MAX_REASON]), at_ms=wall_ms())
        self._controller.stop(latch, message=stop.id)
        self._wake()
        _log.warning("%s: stopped by %s", self.name, latch.caller)

    def _accept_setpoint(self, topic: topics.Topic, payload: bytes) -> None:
        now_s = time.monotonic()
        lease = self._controller.lease(now_s)
        if lease is None or topic.name != str(lease.epoch):
            raise Refused("no_lease", f"lease {topic.name} is not in force")
        setpoint = codec.decode(setpoints.open_sealed(payload, lease.keys), Setpoint)
        self._controller.accept_setpoint(setpoint, now_s=now_s, tick_ms=tick_ms())
        self._wake()

    def _wake(self) -> None:
        """Run the next control period without waiting, if possible."""
        self._loop.wake()

    def link_changed(self, up: bool) -> None:
        """Handle a change of the link."""
        self._camera_streamer.link_changed(up)
        if up:
            self._commands.on_connected()
        else:
            self._controller.interrupt(Refused("link_lost", "the device lost its link"))
