"""A real agent in a separate process without the functions: the test signs commands and grants broker permissions.

``python -m tests.harness.agent.custom_agent HOME`` runs it with the credentials in ``HOME/access.json``.
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
    Stored,
    codec,
    topics,
)
from device_agent.protocol.acks import message_id
from device_agent.protocol.security import grants, signing
from tests.harness.network.brokers import HOST, Client, Message, RunningBroker, wait_until
from tests.harness.paths import ROOT

SPACE, AGENT, DEVICE = "lab", "arm1", "arm"
_ACCESS = "access.json"
_KINDS = (topics.STATE, topics.ACK, topics.EVENT)


class FileApi:
    """Replaces the HTTP API; reads the credentials from a file."""

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
        credentials: dict[str, Any] = json.loads(self._path.read_text())
        return credentials


class AgentProcess:
    """The agent's process, and a broker connection with the permissions of the functions.

    Args:
        folder: Home folder of the agent.
        broker: A running broker.
        toml: Text of ``agent.toml`` after server and name, with one device ``arm``. Nothing is recorded by default.

    Attributes:
        messages: Topic and payload of each message received from the agent.
    """

    def __init__(self, folder: Path, broker: RunningBroker, toml: str) -> None:
        self.store = IdentityStore(folder)
        self.key = signing.generate()
        self.store.private_key(create=True)
        keys = {signing.key_id(self.key.public_key()): signing.public_text(self.key.public_key())}
        self.store.save_pairing(Pairing(agent=AGENT, space=SPACE, account="ann", keys=keys))
        recording = "" if "[recording]" in toml else "\n[recording]\nenabled = false\n"
        (folder / "agent.toml").write_text(f'server = "http://server.invalid"\nname = "arm"\n{toml}{recording}')
        self.process: subprocess.Popen[bytes] | None = None
        self.messages: list[tuple[str, bytes]] = []
        self.use_broker(broker)

    def use_broker(self, broker: RunningBroker) -> None:
        """Connect to this broker and issue new credentials for the agent."""
        grant = grants.agent_grant(SPACE, AGENT, token_id=os.urandom(8).hex(), lifetime_s=300)
        login = broker.issue(grant)
        access = {
            "tcp": {"host": HOST, "port": broker.tcp_port},
            "client_id": AGENT,
            "username": login.username,
            "password": login.password,
            "subscribe": grants.agent_command_topics(SPACE, AGENT),
            "lifetime_s": 300,
            "confirmations": grants.agent_confirmations(SPACE, AGENT),
        }
        (self.store.folder / _ACCESS).write_text(json.dumps(access))
        self.client: Client = broker.service(on_message=self._confirm)
        self.client.subscribe(*(self.topic(kind) for kind in _KINDS))
        self.client.subscribe(self.topic(topics.TELE, "+"), self.topic(topics.LATE, "+"))

    def start(self) -> Self:
        command = [sys.executable, "-m", "tests.harness.agent.custom_agent", str(self.store.folder)]
        log = (self.store.folder / "log").open("a")
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
        log.close()
        return self

    def kill(self) -> None:
        """Kill the agent; the context manager terminates it by SIGTERM."""
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
        self.client.close()

    # ------------------------------------------------------------ commands

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
        self.client.publish(self.topic(topics.CMD), signing.sign(codec.encode(command), self.key))
        return command.id

    def execute(self, request: Request, *, epoch: int = 0) -> Ack:
        """Send a command and wait for its final acknowledgement."""
        return self.final_ack(self.command(request, epoch=epoch))

    def move(self, target_rad: float, *, epoch: int, speed: float = 0.3) -> str:
        """Grant a lease and turn the base. Returns the command's id when the arm moves."""
        self.execute(GrantLease(holder="ann", lease_ms=60_000), epoch=epoch)
        command = self.command(MoveJoints(position_rad={"shoulder_pan": target_rad}, speed=speed), epoch=epoch)
        wait_until(lambda: self.speeds()[-3:] and min(self.speeds()[-3:]) > 0.05, "the arm to move")
        return command

    # ------------------------------------------------------------ messages

    def _confirm(self, message: Message) -> None:
        """Confirm a received message as the functions do."""
        if topics.parse(message.topic).kind in topics.CONFIRMED:
            stored = Stored(ids=(message_id(message.topic, message.payload),))
            self.client.publish(self.topic(topics.STORED), codec.encode(stored), qos=0)

    def _receive_pending(self) -> list[tuple[str, bytes]]:
        self.messages += [(message.topic, message.payload) for message in self.client.pending()]
        return self.messages

    def received(self, kind: str, message: type[Any], name: str = "") -> list[Any]:
        """All messages received on one topic, decoded."""
        expected = self.topic(kind, name)
        return [codec.decode(payload, message) for topic, payload in self._receive_pending() if topic == expected]

    def final_ack(self, command: str) -> Ack:
        """Wait for the final acknowledgement of a command."""
        acks: list[Ack] = []

        def ended() -> bool:
            acks[:] = [ack for ack in self.received(topics.ACK, Ack) if ack.id == command and ack.status.terminal]
            return bool(acks)

        wait_until(ended, f"the end of {command}")
        return acks[0]

    def telemetry(self) -> list[JointTelemetry]:
        return self.received(topics.TELE, JointTelemetry, topics.JOINTS)

    def speeds(self, *, since: int = 0) -> list[float]:
        """Commanded speed of the base between consecutive measurements, starting with number ``since`` [rad/s]."""
        measurements = self.telemetry()[since:]
        return [
            abs(after.commanded_rad[0] - before.commanded_rad[0]) / (after.tick_ms - before.tick_ms) * 1000
            for before, after in pairwise(measurements)
            if after.tick_ms > before.tick_ms
        ]

    def state(self) -> State:
        """The newest state; waits for the first one."""
        wait_until(lambda: self.received(topics.STATE, State), "a state")
        newest: State = self.received(topics.STATE, State)[-1]
        return newest

    def events(self, kind: str) -> list[Event]:
        """All events of a kind; repeated ones once."""
        events = {event.id: event for event in self.received(topics.EVENT, Event)}
        return [event for event in events.values() if event.kind == kind]

    def ready(self) -> None:
        """Wait for telemetry over the current connection."""
        before = len(self.telemetry())
        wait_until(lambda: len(self.telemetry()) > before + 3, "telemetry")


class Sensor:
    """A fake room device of another agent; a context manager that publishes ``values`` at 10 Hz.

    Attributes:
        values: Published values; ``None``: no messages.
    """

    def __init__(self, broker: RunningBroker, agent: str, device: str, stream: str, **values: float | bool) -> None:
        grant = grants.agent_grant(SPACE, agent, token_id=os.urandom(8).hex(), lifetime_s=300)
        self._client = broker.connect(agent, broker.issue(grant))
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
        self._client.close()

    def _run(self) -> None:
        while not self._ending.wait(0.1):
            values = self.values
            if values is not None:
                self._sequence += 1
                message = Measurements(tick_ms=tick_ms(), at_ms=wall_ms(), sequence=self._sequence, values=values)
                self._client.publish(self._topic, codec.encode(message), qos=0)


if __name__ == "__main__":
    with mock.patch.object(bootstrap, "cloud_client", lambda store, _configuration, clock, **_: FileApi(store, clock)):
        sys.exit(main(["run", "--home", sys.argv[1]]))
