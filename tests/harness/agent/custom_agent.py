"""A real agent in a process of its own, without the functions: a test has their key, and gives the broker's rights.

``python -m tests.harness.agent.custom_agent HOME`` runs it; its credentials are in ``access.json`` there.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import uuid
from itertools import pairwise
from pathlib import Path
from typing import Any, Self
from unittest import mock

from device_agent import bootstrap
from device_agent.__main__ import main
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.protocol import (
    Ack,
    Command,
    Event,
    GrantLease,
    JointTelemetry,
    Measurements,
    MoveJoints,
    Request,
    State,
    codec,
    topics,
)
from device_agent.protocol.security import grants, signing
from tests.harness.network.brokers import HOST, Client, RunningBroker, wait_until
from tests.harness.paths import ROOT

SPACE, AGENT, DEVICE = "lab", "arm1", "arm"
_ACCESS = "access.json"
_HEARD = (topics.STATE, topics.ACK, topics.EVENT)


class _Api:
    """What the agent asks the functions for, from a file."""

    server = "http://server.invalid"
    ca = None

    def __init__(self, store: IdentityStore, clock: CloudClock) -> None:
        self._path = store.folder / _ACCESS
        self._clock = clock

    def enroll(self, **_: object) -> Any:
        return mock.Mock(code=None)

    def credentials(self) -> dict[str, Any]:
        now = tick_ms()
        self._clock.observe(server_ms=wall_ms(), sent_tick_ms=now, received_tick_ms=now)
        found: dict[str, Any] = json.loads(self._path.read_text())
        return found


class OwnAgent:
    """The agent's process, the connection on which the functions would speak with it, and all that was heard.

    Args:
        folder: Its store.
        broker: Running.
        toml: ``agent.toml`` below server and name; one device ``arm``.
    """

    def __init__(self, folder: Path, broker: RunningBroker, toml: str) -> None:
        self.store = IdentityStore(folder)
        self.key = signing.generate()
        self.store.private_key(create=True)
        keys = {signing.key_id(self.key.public_key()): signing.public_text(self.key.public_key())}
        self.store.save_pairing(Pairing(agent=AGENT, space=SPACE, account="ann", keys=keys))
        (folder / "agent.toml").write_text(f'server = "http://server.invalid"\nname = "arm"\n{toml}')
        self.process: subprocess.Popen[bytes] | None = None
        self.heard: list[tuple[str, bytes]] = []
        self.use(broker)

    def use(self, broker: RunningBroker) -> None:
        """Speak over this broker from now on."""
        grant = grants.agent_grant(SPACE, AGENT, token_id=os.urandom(8).hex(), lifetime_s=300)
        login = broker.issue(grant)
        access = {
            "tcp": {"host": HOST, "port": broker.tcp_port},
            "client_id": AGENT,
            "username": login.username,
            "password": login.password,
            "subscribe": grants.agent_command_topics(SPACE, AGENT),
            "lifetime_s": 300,
        }
        (self.store.folder / _ACCESS).write_text(json.dumps(access))
        self.line: Client = broker.service()
        self.line.subscribe(*(self.topic(kind) for kind in _HEARD))
        self.line.subscribe(self.topic(topics.TELE, "+"), self.topic(topics.LATE, "+"))

    def start(self) -> Self:
        command = [sys.executable, "-m", "tests.harness.agent.custom_agent", str(self.store.folder)]
        log = (self.store.folder / "log").open("a")
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
        log.close()
        return self

    def kill(self) -> None:
        """As a machine that loses its power; ``with`` ends it in order."""
        assert self.process is not None
        self.process.kill()
        self.process.wait(20)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(20)
            except subprocess.TimeoutExpired:
                self.process.kill()
        self.line.close()

    # ------------------------------------------------------------ to it

    @staticmethod
    def topic(kind: str, name: str = "") -> str:
        return topics.device(SPACE, AGENT, DEVICE, kind, name)

    def command(self, request: Request, *, epoch: int = 0, command_id: str = "", ttl_ms: int = 20_000) -> str:
        command = Command(
            id=command_id or f"c{uuid.uuid4().hex[:10]}",
            space=SPACE,
            agent=AGENT,
            device=DEVICE,
            issued_at_ms=wall_ms(),
            ttl_ms=ttl_ms,
            caller="ann",
            epoch=epoch,
            request=request,
        )
        self.line.publish(self.topic(topics.CMD), signing.sign(codec.encode(command), self.key))
        return command.id

    def execute(self, request: Request, *, epoch: int = 0) -> Ack:
        """A command that ends at once; its last answer."""
        return self.ended(self.command(request, epoch=epoch))

    def move(self, target_rad: float, *, epoch: int, speed: float = 0.3) -> str:
        """Take control and turn the base; the action's id once it moves."""
        self.execute(GrantLease(holder="ann", lease_ms=60_000), epoch=epoch)
        command = self.command(MoveJoints(position_rad={"shoulder_pan": target_rad}, speed=speed), epoch=epoch)
        wait_until(lambda: self.speeds()[-3:] and min(self.speeds()[-3:]) > 0.05, "the arm to move")
        return command

    # ------------------------------------------------------------ from it

    def _listen(self) -> list[tuple[str, bytes]]:
        self.heard += [(message.topic, message.payload) for message in self.line.pending()]
        return self.heard

    def told(self, kind: str, message: type[Any], name: str = "") -> list[Any]:
        wanted = self.topic(kind, name)
        return [codec.decode(payload, message) for topic, payload in self._listen() if topic == wanted]

    def ended(self, command: str) -> Ack:
        """The last answer to a command, once there is one."""
        found: list[Ack] = []

        def over() -> bool:
            found[:] = [ack for ack in self.told(topics.ACK, Ack) if ack.id == command and ack.status.terminal]
            return bool(found)

        wait_until(over, f"the end of {command}")
        return found[0]

    def telemetry(self) -> list[JointTelemetry]:
        return self.told(topics.TELE, JointTelemetry, topics.JOINTS)

    def speeds(self, *, since: int = 0) -> list[float]:
        """Commanded speed of the base between each two measurements that were told, from one on [rad/s]."""
        seen = self.telemetry()[since:]
        return [
            abs(after.commanded_rad[0] - before.commanded_rad[0]) / (after.tick_ms - before.tick_ms) * 1000
            for before, after in pairwise(seen)
            if after.tick_ms > before.tick_ms
        ]

    def state(self) -> State:
        """The newest."""
        wait_until(lambda: self.told(topics.STATE, State), "a state")
        newest: State = self.told(topics.STATE, State)[-1]
        return newest

    def events(self, kind: str) -> list[Event]:
        return [event for event in self.told(topics.EVENT, Event) if event.kind == kind]

    def ready(self) -> None:
        """Wait until it measures over this link."""
        before = len(self.telemetry())
        wait_until(lambda: len(self.telemetry()) > before + 3, "telemetry")


class Sensor:
    """A room device behind another agent, as the broker sees it. Says ``values`` ten times a second; ``None``: nothing.

    ``with`` ends it.
    """

    def __init__(self, broker: RunningBroker, agent: str, device: str, stream: str, **values: float | bool) -> None:
        grant = grants.agent_grant(SPACE, agent, token_id=os.urandom(8).hex(), lifetime_s=300)
        self._line = broker.connect(agent, broker.issue(grant))
        self._topic = topics.device(SPACE, agent, device, topics.TELE, stream)
        self._sequence = 0
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.values: dict[str, float | bool] | None = values

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join(5)
        self._line.close()

    def _run(self) -> None:
        while not self._ending.wait(0.1):
            values = self.values
            if values is not None:
                self._sequence += 1
                message = Measurements(tick_ms=tick_ms(), at_ms=wall_ms(), sequence=self._sequence, values=values)
                self._line.publish(self._topic, codec.encode(message), qos=0)


if __name__ == "__main__":
    with mock.patch.object(bootstrap, "cloud_client", lambda store, _configuration, clock, **_: _Api(store, clock)):
        sys.exit(main(["run", "--home", sys.argv[1]]))
