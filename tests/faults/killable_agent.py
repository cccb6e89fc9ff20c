"""A real device with a fake arm, in processes that kill themselves at any step.

``python -m tests.faults.killable_agent`` is a warm parent process. Each input line is one run (JSON, see ``Run``). The
parent executes it in a fork and prints the exit status. A step is a write to the journal, a published message or the
start of a move; a ``kill -9`` can occur between steps.

A run appends to files that persist: ``published`` contains each published acknowledgement, one per line; ``moved`` each
move of the arm, with the number of the command and the cloud time.
"""

import json
import logging
import os
import random
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.protocol import Ack, Command, codec, topics
from device_agent.protocol.security import signing
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.device import Device
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.storage.journal import Journal
from device_agent.runtime.storage.outbox_store import OutboxStore
from device_agent.runtime.telemetry.outbox import Outbox
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.pinned_keys import pinned_keys_of
from tests.harness.agent.sandbox import LateSandbox

TARGET_RAD = 1e-4
"""Factor from the elbow's target [rad] to the number of the command, so that each move identifies its command."""
SPACE, AGENT, DEVICE = "s", "a", "arm"
_TIMEOUT_S = 60.0
_LINK_LOST = 0.03
_UNACKNOWLEDGED = 0.25


class Run(msgspec.Struct):
    """One run of the agent process.

    Attributes:
        folder: Folder of the journal, ``published`` and ``moved``.
        key: The cloud's private key, base64.
        kill_at_step: Step at which the process is killed; ``None``: runs until all commands have ended.
        cloud_ms: Cloud time at the start; independent of the machine's clock [ms].
        seed: Seed of the simulated link.
        commands: Command bodies in command of arrival, with duplicates.
    """

    folder: str
    key: bytes
    kill_at_step: int | None
    cloud_ms: int
    seed: int
    commands: list[Command]


class Steps:
    """Counts steps and kills the process at the chosen one."""

    def __init__(self, kill_at_step: int | None) -> None:
        self._dies_at = kill_at_step
        self._lock = threading.Lock()
        self.count = 0

    def step(self) -> None:
        with self._lock:
            if self._dies_at is not None and self.count >= self._dies_at:
                os.kill(os.getpid(), signal.SIGKILL)
                time.sleep(_TIMEOUT_S)  # wait for the signal; no further step may run
            self.count += 1

    def around(self, owner: Any, name: str) -> Any:
        """A patch that counts a step before and after a call."""
        original = getattr(owner, name)

        def stepping(*arguments: Any, **options: Any) -> Any:
            self.step()
            result = original(*arguments, **options)
            self.step()
            return result

        return mock.patch.object(owner, name, stepping)


class AppendOnlyFile:
    """An append-only file of whole lines; written lines survive a kill of the process."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)

    def add(self, **row: Any) -> None:
        os.write(self._file, json.dumps(row).encode() + b"\n")
        os.fsync(self._file)


class DeviceRun:
    """The device of one run."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.folder = Path(run.folder)
        self.steps = Steps(run.kill_at_step)
        self.rng = random.Random(run.seed)
        self.published = AppendOnlyFile(self.folder / "published")
        self.moved = AppendOnlyFile(self.folder / "moved")
        self.ended: set[str] = set()
        self.clock = CloudClock()
        self.clock.observe(server_ms=run.cloud_ms, sent_tick_ms=tick_ms(), received_tick_ms=tick_ms())

    def execute(self) -> None:
        key = Ed25519PrivateKey.from_private_bytes(self.run.key)
        writes = [self.steps.around(Journal, name) for name in ("begin", "record", "delivered", "save_epoch")]
        with mock.patch.object(Controller, "start_joint_goal", self._counted(Controller.start_joint_goal)):
            for write in writes:
                write.start()
            journal = Journal(self.folder / "journal.db")
            journal.open(now_ms=wall_ms())
            journal.end_open(now_ms=wall_ms(), tick_ms=tick_ms())
            device = Device(
                name=DEVICE, label="Arm", space=SPACE, agent=AGENT, robot_type=fast_arm(), driver=FakeDriver(),
                journal=journal, cloud_clock=self.clock, publish=self._publish, sandbox=LateSandbox(),
                keys=pinned_keys_of(key),
                readings=ReadingCache(space=SPACE, agent=AGENT, own=[DEVICE]), outbox=self._outbox(),
            )  # fmt: skip
            device.start()
            device.link_changed(True)
            self._deliver(device, key)
            device.stop()
            journal.close()

    def _outbox(self) -> Outbox:
        own = f"ts/v1/{SPACE}/{AGENT}/"
        store = OutboxStore(self.folder / "outbox.db", own=own, max_bytes=10**7, max_age_ms=3_600_000)
        return Outbox(store, publish=self._publish, device_topic=own + DEVICE)

    def _deliver(self, device: Device, key: Ed25519PrivateKey) -> None:
        topic = topics.Topic(SPACE, AGENT, DEVICE, topics.CMD)
        for command in self.run.commands:
            device.receive(topic, signing.sign(codec.encode(command), key))
            if self.rng.random() < _LINK_LOST:
                device.link_changed(False)
                device.link_changed(True)
            time.sleep(self.rng.choice((0, 0.005, 0.03)))
        deadline_s = time.monotonic() + _TIMEOUT_S
        commands = {command.id for command in self.run.commands}
        while not commands <= self.ended:
            assert time.monotonic() < deadline_s, f"without a final state: {commands - self.ended}"
            time.sleep(0.002)

    def _counted(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def move(controller: Controller, reservation: Any, position_rad: dict[str, float], **options: Any) -> Any:
            self.steps.step()
            moving = original(controller, reservation, position_rad, **options)
            self.moved.add(number=round(position_rad["elbow"] / TARGET_RAD), cloud_ms=self.clock.now_ms())
            self.steps.step()
            return moving

        return move

    def _publish(
        self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Callable[[], None] | None = None
    ) -> bool:
        """A transport that sometimes does not acknowledge, and drops measurements."""
        del qos, retain
        if topics.parse(topic).kind != topics.ACK:
            return True
        self.steps.step()
        ack = codec.decode(payload, Ack)
        self.published.add(
            id=ack.id, status=ack.status, code=ack.reason.code if ack.reason else "", progress=ack.progress
        )
        self.steps.step()
        if delivered is not None and self.rng.random() > _UNACKNOWLEDGED:
            delivered()
        if ack.status.terminal:
            self.ended.add(ack.id)
        return True


def fast_arm() -> Any:
    """A fake arm that reaches each target immediately, so that a thousand runs take minutes."""
    slow = robot_type()
    joints = tuple(
        msgspec.structs.replace(
            joint,
            max_velocity_rad_s=100.0,
            max_acceleration_rad_s2=1e4,
            max_jerk_rad_s3=1e7,
            lower_rad=-30,
            upper_rad=30,
        )
        for joint in slow.joints
    )
    return msgspec.structs.replace(slow, joints=joints, period_ms=4, braking_rad_s2=2e4)


def main() -> None:
    logging.disable()
    for line in sys.stdin:
        run = msgspec.json.decode(line, type=Run)
        child = os.fork()
        if child == 0:
            code = 1
            try:
                device_run = DeviceRun(run)
                device_run.execute()
                code = 0
            except BaseException as error:
                print(f"{type(error).__name__}: {error}", file=sys.stderr)
                raise
            finally:
                os._exit(code)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
