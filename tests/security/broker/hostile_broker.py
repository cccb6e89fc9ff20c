"""A broker that attacks one device: it replays, reorders, edits and injects messages, and mints grants of its own.

The honest cloud and operator only ever request motion of the elbow. Every forged request is for the shoulder.
"""

import random
from pathlib import Path

from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.protocol import (
    Command,
    GrantLease,
    JointTarget,
    MoveJoints,
    ResetStop,
    Setpoint,
    StopLatch,
    WithdrawRequest,
    codec,
)
from device_agent.protocol.security import setpoints, signing
from device_agent.runtime.agent import Agent
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import FakeDriver
from tests.harness.agent.device_harness import DeviceHarness
from tests.harness.agent.pinned_keys import IDENTITY

OWN = "ts/v1/s/a/arm"
TARGET = JointTarget(position_rad={"shoulder": 2.0})
AUTHORS = ("owner", "ann", "", "eve\n2026 WARNING forged line", "eve\x1b[2K", "\u202eowner", "a/b", "x" * 65)
_KEPT = 50
"""Number of captured messages that the broker may replay."""


class WatchedDriver(FakeDriver):
    """Records the largest forged motion."""

    forged_rad = 0.0

    def send(self, position_rad: tuple[float, ...]) -> tuple[float, ...]:  # type: ignore[override]
        self.forged_rad = max(self.forged_rad, abs(position_rad[0]))
        return super().send(position_rad)


class AttackedDevice(DeviceHarness):
    """A device whose messages all pass through the broker.

    Attributes:
        accepted: Epoch and sequence of each accepted setpoint, in order.
        sent: Honest setpoints by epoch and sequence.
        captured: Honest messages: topic and payload.
    """

    def __init__(self, folder: Path) -> None:
        self.watched = WatchedDriver()
        super().__init__(folder, driver=self.watched)
        self.captured: list[tuple[str, bytes]] = []
        self.accepted: list[Setpoint] = []
        self.sent: list[Setpoint] = []
        accept = self.device._controller.accept_setpoint

        def recording(setpoint: Setpoint, *, now_s: float, tick_ms: int) -> None:
            accept(setpoint, now_s=now_s, tick_ms=tick_ms)
            self.accepted.append(setpoint)

        self.device._controller.accept_setpoint = recording  # type: ignore[method-assign]

    def receive(self, kind: str, payload: bytes, name: str = "") -> None:
        self.captured = [*self.captured[1 - _KEPT :], (f"{OWN}/{kind}" + (f"/{name}" if name else ""), payload)]
        super().receive(kind, payload, name)

    def new_setpoint(self, epoch: int, sequence: int) -> bytes:
        """The operator's next setpoint, sealed. Each input has ten setpoints."""
        payload = self.sealed(epoch, sequence, (sequence % 7) / 10, number=1 + sequence // 10)
        self.sent.append(codec.decode(bytes(codec.decode(payload, setpoints.Tagged).body), Setpoint))
        return payload


class HostileBroker:
    """Delivers the messages of an honest cloud and operator between its own; see the module."""

    def __init__(self, victim: AttackedDevice, agent: Agent, seed: int) -> None:
        self.random = random.Random(seed)  # noqa: S311 (repeatable)
        self._victim = victim
        self._agent = agent
        self._key = signing.generate()
        self._epoch = self._sequence = 0
        self._withheld: list[tuple[str, bytes]] = []
        self._attacks = (
            self._replay,
            self._edit,
            self._inject_setpoint,
            self._inject_command,
            self._move_elsewhere,
            self._inject_noise,
        )
        self.latches: list[StopLatch] = []
        self.delivered = 0

    def run(self, messages: int) -> None:
        """Deliver about this many messages."""
        while self.delivered < messages:
            self._lease()
            for _ in range(self.random.randrange(50, 400)):
                self._step()
            self._end_lease()

    def _deliver(self, topic: str, payload: bytes) -> None:
        self.delivered += 1
        self._agent._receive(topic, payload)

    def _lease(self) -> None:
        victim = self._victim
        self._epoch, self._sequence = self._epoch + 1, 0
        victim.done(GrantLease(holder="ann", lease_ms=600_000), epoch=self._epoch)
        self.delivered += 1
        if self._epoch == 1 or self.random.random() < 0.2:
            victim.done(MoveJoints(position_rad={"elbow": self.random.random()}, speed=1.0), epoch=self._epoch)
            self.delivered += 1

    def _step(self) -> None:
        if self.random.random() < 0.2:
            self._honest_setpoints()
        else:
            self._deliver(*self.random.choice(self._attacks)())

    def _honest_setpoints(self) -> None:
        """Deliver one or two honest setpoints, in the wrong order, twice, or later."""
        topic = f"{OWN}/ctl/{self._epoch}"
        fresh: list[tuple[str, bytes]] = []
        for _ in range(self.random.randrange(1, 3)):
            self._sequence += 1
            fresh.append((topic, self._victim.new_setpoint(self._epoch, self._sequence)))
        self._victim.captured += fresh
        if self.random.random() < 0.2:
            self._withheld, fresh = [*self._withheld[-_KEPT:], *fresh], []
        for message in self.random.sample(fresh, len(fresh)) * self.random.randrange(1, 3):
            self._deliver(*message)

    # ------------------------------------------------------------ attacks

    def _replay(self) -> tuple[str, bytes]:
        topic, payload = self.random.choice(self._victim.captured + self._withheld)
        if self.random.random() < 0.5 and "/ctl/" in topic:
            topic = f"{OWN}/ctl/{self._epoch + self.random.randrange(-1, 2)}"
        # A withheld setpoint of this lease is the operator's own message: it may be delivered once, late.
        return topic, payload

    def _edit(self) -> tuple[str, bytes]:
        topic, payload = self._replay()
        edited = bytearray(payload)
        for _ in range(self.random.randrange(1, 4)):
            at = self.random.randrange(len(edited))
            edited[at] ^= 1 << self.random.randrange(8)
        choice = self.random.random()
        if choice < 0.3:
            edited = bytearray(payload.replace(b'"elbow"', b'"shoulder"').replace(b'"sequence":', b'"sequence":9'))
        elif choice < 0.4:
            edited = bytearray(payload.replace(b'"input":', b'"input":9'))
        return (topic, bytes(edited)) if edited != payload else (topic, b"")

    def _inject_setpoint(self) -> tuple[str, bytes]:
        """An unsigned setpoint, or one with a key that the broker can compute."""
        topic = f"{OWN}/ctl/{self._epoch}"
        setpoint = Setpoint(
            epoch=self._epoch, sequence=self._sequence + 100, echo_tick_ms=tick_ms(), sent_ms=0.0, target=TARGET
        )
        body = codec.encode(setpoint)
        keys = (
            bytes(32),
            setpoints.lease_key(self._key, IDENTITY.public_key(), topic=topic, pairing=""),
            setpoints.lease_key(self._key, self._victim.key.public_key(), topic=topic, pairing=""),
        )
        return topic, self.random.choice([body, *(setpoints.seal(body, key, topic) for key in keys)])

    def _command(self, *, device: str) -> Command:
        requests = (
            GrantLease(holder="eve", lease_ms=600_000),
            MoveJoints(position_rad=TARGET.position_rad),
            ResetStop(),
        )
        return Command(
            id=f"h{self.delivered}", space="s", agent="a", device=device, issued_at_ms=wall_ms(), ttl_ms=60_000,
            caller="ann", epoch=self._epoch + 1, request=self.random.choice(requests),
        )  # fmt: skip

    def _inject_command(self) -> tuple[str, bytes]:
        """A minted command, also under the name of the pinned key."""
        payload = signing.sign(codec.encode(self._command(device="arm")), self._key)
        names = [signing.key_id(key.public_key()).encode() for key in (self._key, self._victim.key)]
        return f"{OWN}/cmd", payload.replace(names[0], self.random.choice(names))

    def _move_elsewhere(self) -> tuple[str, bytes]:
        """A command that the cloud signed for another device."""
        return f"{OWN}/cmd", signing.sign(codec.encode(self._command(device="leg")), self._victim.key)

    def _inject_noise(self) -> tuple[str, bytes]:
        kinds = ("desc", "state", "ack", "event", "tele/joints", "ctl/x", "../conn", "cmd", "ctl/1/2", "\n\x1b[31m")
        topic = self.random.choice([f"{OWN}/{self.random.choice(kinds)}", "ts/v1/s/a/conn", "ts/v1/s/a/+/cmd"])
        online = b'{"online":false,"session":99,"at_ms":1}'
        return topic, self.random.choice([online, b"null", self.random.randbytes(40), b'{"\\n\\u001b[2K":1}'])

    # ------------------------------------------------------------ Stop

    def stop(self, count: int) -> None:
        """Stop the device in other names."""
        for _ in range(count):
            author = self.random.choice(AUTHORS)
            fields = {"id": "s1", "caller": author, "reason": f"{author}\n\x1b[2K", "verified": True}
            self._deliver(f"{OWN}/stop/{author}" if author else f"{OWN}/stop", codec.encode(fields))

    def _end_lease(self) -> None:
        """Stop the device, attack it while it is stopped, and let the cloud reset it."""
        self.stop(self.random.randrange(0, 4))
        if (latch := self._victim.device._controller.latch) is not None:
            self.latches.append(latch)
        for _ in range(20):
            self._deliver(*self.random.choice(self._attacks)())
        self._victim.done(WithdrawRequest(request="none"), epoch=self._epoch)
        self._epoch += 1
        self._victim.done(ResetStop(), epoch=self._epoch)
        self.delivered += 2


def agent_of(victim: AttackedDevice) -> Agent:
    """The agent that routes messages to the device."""

    class _Link:
        def start(self, *_: object) -> None:
            raise Refused("unused", "the broker calls the agent directly")

        def publish(self, *_: object, **__: object) -> bool:
            return False

        def stop(self) -> None:
            return

    return Agent(
        {"arm": victim.device}, _Link(), outbox=victim.outbox, readings=victim.readings, address=("s", "a")
    )  # fmt: skip
