"""A simulated agent whose acknowledgements the test defines."""

import json
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Self, TypeVar

import httpx
import jwt

from device_agent.protocol import (
    Ack,
    AckStatus,
    Command,
    GrantLease,
    Presence,
    Reason,
    ReleaseLease,
    ResetStop,
    RunMovement,
    RunTrial,
    State,
    Stop,
    StopDevice,
    Task,
    codec,
    topics,
)
from device_agent.protocol.security import signing
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.errors import Refused
from function_app.domain.common.ids import agent_id
from function_app.entrypoints.http.framework.routing import PREFIX
from tests.harness.network.brokers import Client, Message

if TYPE_CHECKING:
    from tests.harness.cloud.cloud import Cloud, Person

T = TypeVar("T")
Acks = Iterable[AckStatus | Ack]


class Robot:
    """Enrolls with its own key, connects with credentials from the API, and acknowledges signed commands.

    A duplicate command is not executed again; the last ack is repeated. An action that arrives late has expired.

    Attributes:
        reports: Returns the acks of a new action. Tests may replace it.
        silent: Send no acks.
        robot_type: Robot type of its devices, set before the enrollment.
        gate: Rejects outdated epochs, as a device does; ``None``: accepts every epoch.
    """

    def __init__(self, cloud: "Cloud", names: tuple[str, ...]) -> None:
        self.cloud = cloud
        self.names = names
        self.key = signing.generate()
        self.public = signing.public_text(self.key.public_key())
        self.id = agent_id(signing.key_id(self.key.public_key()))
        self.devices = [f"{self.id}-{name}" for name in names]
        self.space = ""
        self.session = 0
        self.silent = False
        self.robot_type = "ur5"
        self.gate: LeaseGate | None = None
        self.reports: Callable[[Command], Acks] = lambda _: (AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED)
        self.commands: list[Command] = []
        self.payloads: dict[str, list[bytes]] = {}
        self.stops: list[Stop] = []
        self.link: Client | None = None
        self._keys: dict[str, Any] = {}
        self._sequences: dict[str, int] = {}
        self._last_acks: dict[str, bytes] = {}

    @property
    def device(self) -> str:
        return self.devices[0]

    # ------------------------------------------------------------ HTTP

    def token(self, **changes: Any) -> str:
        """A request token, signed with the agent's key."""
        key = changes.pop("key", self.key)
        now_s = self.cloud.clock.now_ms() // 1000
        claims = {"iss": "agent", "aud": "telescope/api", "iat": now_s, "exp": now_s + 60, "jti": str(time.time_ns())}
        return jwt.encode(
            {name: value for name, value in {**claims, **changes}.items() if value is not None},
            key,
            "EdDSA",
            headers={"kid": signing.key_id(key.public_key())},
        )

    def request(self, method: str, path: str, *, token: str = "", **options: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {token or self.token()}"}
        return self.cloud.request(method, PREFIX + path, headers=headers, **options)

    def introduction(self, **changes: Any) -> dict[str, Any]:
        common = {"kind": "arm", "robot_type": self.robot_type}
        devices = [{"name": name, **common, "label": name.title()} for name in self.names]
        return {"name": "lab", "public_key": self.public, "software": "simulated 1", "devices": devices, **changes}

    def enroll(self, **changes: Any) -> httpx.Response:
        return self.request("POST", "/agents/enroll", json=self.introduction(**changes))

    def code(self) -> str:
        answer = self.enroll()
        assert answer.status_code == 201, answer.text
        code: str = answer.json()["claim_code"]
        return code

    def enrollment(self, wait_ms: int = 0) -> dict[str, Any]:
        answer = self.request("GET", "/agents/enrollment", params={"wait_ms": wait_ms})
        assert answer.status_code == 200, answer.text
        state: dict[str, Any] = answer.json()
        return state

    def pair(self, owner: "Person") -> str:
        """Enroll, and claim for ``owner``; return the id of the first device."""
        answer = owner.post("/agents/claim", {"code": self.code()})
        assert answer.status_code == 200, answer.text
        state = self.enrollment()
        self.space = state["space"]
        self._keys = {key["id"]: signing.public_key(key["public"]) for key in state["keys"]}
        return self.device

    # ------------------------------------------------------------ MQTT

    def connect(self) -> Self:
        """Connect with credentials from the API, subscribe, and publish the presence."""
        issued = self.request("POST", "/mqtt/credentials", json={"purpose": "agent"}).json()
        self.session += 1
        self.link = self.cloud.connect(issued, on_message=lambda message: self.handle(message))  # noqa: PLW0108 (tests replace it)
        assert self.link.connected.is_set(), f"refused: {self.link.answer}"
        assert self.link.subscribe(*issued["subscribe"]) == [1] * len(issued["subscribe"])
        self.publish_presence(online=True)
        return self

    def topic(self, kind: str, name: str = "") -> str:
        return topics.device(self.space, self.id, name or self.names[0], kind)

    def publish(self, topic: str, message: Any, *, retain: bool = False) -> None:
        assert self.link is not None
        self.link.publish_acknowledged(topic, codec.encode(message), retain=retain)

    def publish_presence(self, *, online: bool, session: int | None = None) -> None:
        number = self.session if session is None else session
        message = Presence(online=online, session=number, at_ms=self.cloud.clock.now_ms())
        self.publish(topics.conn(self.space, self.id), message, retain=True)

    def publish_state(self, state: State) -> None:
        self.publish(self.topic(topics.STATE), state, retain=True)

    def ack(self, command: str, status: AckStatus, **more: Any) -> Ack:
        sequence = self._sequences[command] = self._sequences.get(command, 0) + 1
        at_ms = self.cloud.clock.now_ms()
        return replace_ack(Ack(id=command, status=status, sequence=sequence, at_ms=at_ms, tick_ms=at_ms), more)

    def report(self, command: str, status: AckStatus, **more: Any) -> Ack:
        """Publish an ack of an action."""
        ack = self.ack(command, status, **more)
        self.publish(self.topic(topics.ACK), ack)
        return ack

    def forget(self, command: str) -> None:
        """Behave as if the command had not arrived."""
        del self.payloads[command]
        self.commands = [each for each in self.commands if each.id != command]

    def fail(self, command: str, code: str, message: str) -> None:
        self.report(command, AckStatus.FAILED, reason=Reason(code=code, message=message))

    def received(self, kind: type[T]) -> list[Command]:
        """Received commands of this kind, in order."""
        return [command for command in self.commands if isinstance(command.request, kind)]

    def handle(self, message: Message) -> None:
        """Process a received message; runs in the thread of the connection."""
        topic = topics.parse(message.topic)
        if topic.kind == topics.STOP:
            self.stops.append(codec.decode(message.payload, Stop))
        if topic.kind != topics.CMD:
            return
        command = codec.decode(signing.verify(message.payload, self._keys), Command)
        seen = self.payloads.setdefault(command.id, [])
        seen.append(message.payload)
        topic_of_acks = topics.device(topic.space, topic.agent, topic.device, topics.ACK)
        if len(seen) > 1 and not self._rejected_before(command):
            if command.id in self._last_acks and not self.silent and self.link is not None:
                self.link.publish(topic_of_acks, self._last_acks[command.id])
            return
        self.commands.append(command)
        if self.silent or self.link is None:
            return
        action = isinstance(command.request, Task | RunMovement | RunTrial)
        reports: Acks = self.reports(command) if action else (AckStatus.RECEIVED, AckStatus.DONE)
        if action and self.cloud.clock.now_ms() > command.issued_at_ms + command.ttl_ms:
            reports = (AckStatus.EXPIRED,)
        for each in self._rejection(command) or reports:
            ack = each if isinstance(each, Ack) else self.ack(command.id, each)
            self._last_acks[command.id] = codec.encode(ack)
            self.link.publish(topic_of_acks, self._last_acks[command.id])

    def _rejection(self, command: Command) -> tuple[AckStatus | Ack, ...]:
        """The acks of a command with an outdated epoch; empty if the device accepts it."""
        if self.gate is None:
            return ()
        try:
            _apply_epoch(self.gate, command)
        except Refused as refused:
            reason = Reason(code=refused.code, message=refused.message, epoch=self.gate.epoch)
            return AckStatus.RECEIVED, self.ack(command.id, AckStatus.FAILED, reason=reason)
        return ()

    def _rejected_before(self, command: Command) -> bool:
        """Whether a rejected command was sent again with an epoch that the device has not seen."""
        if self.gate is None or command.epoch <= self.gate.epoch or command.id not in self._last_acks:
            return False
        reason = codec.decode(self._last_acks[command.id], Ack).reason
        return reason is not None and reason.epoch > 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.link is not None:
            self.link.close()


def _apply_epoch(gate: LeaseGate, command: Command) -> None:
    """Apply a command to the epochs of a device. Raises ``Refused``."""
    match command.request:
        case GrantLease(lease_ms=lease_ms):
            gate.grant(epoch=command.epoch, holder="", lease_s=lease_ms / 1000, now_s=0)
        case StopDevice():
            gate.burn()
        case ReleaseLease() | ResetStop():
            gate.fence(command.epoch)
            gate.burn()
        case request if isinstance(request, Task | RunMovement):
            gate.fence(command.epoch)
            if command.epoch <= gate.burned:
                raise Refused("lease_ended", f"lease {command.epoch} has ended at the device")


def replace_ack(ack: Ack, changes: dict[str, Any]) -> Ack:
    return codec.decode(json.dumps({**json.loads(codec.encode(ack)), **_plain(changes)}).encode(), Ack)


def _plain(changes: dict[str, Any]) -> dict[str, Any]:
    return {name: json.loads(codec.encode(value)) for name, value in changes.items()}
