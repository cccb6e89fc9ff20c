"""Agents, their devices, and their last reported state."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from function_app.domain.common.timestamps import NEVER_MS
from function_app.domain.identity.accounts import Role

SILENT_MS = 90_000
"""An agent publishes state every 30 s; after three missed messages it counts as offline."""
POLL_SILENT_MS = 45_000
"""A polling agent sends a request at least every 30 s."""
POLL_MARK_MS = 15_000
"""Minimum interval between two stored polls of an agent."""

_MAX_DEPARTURES = 16
"""Departures accumulate only while a broker is unreachable; beyond this limit the oldest are dropped."""

Transport = Literal["mqtt", "http", "xmpp"]
"""How an agent receives commands. Agents without MQTT, and the XMPP gateway, fetch them by HTTP."""


@dataclass(frozen=True, slots=True)
class DeviceSpec:
    """A device as its agent describes it at enrolment."""

    name: str
    kind: str
    robot_type: str
    label: str


@dataclass(frozen=True, slots=True)
class Departure:
    """Devices that left an account or space, and whose data must still be cleaned up."""

    why: Literal["unpaired", "moved", "removed"]
    account: str
    space: str
    pairing: str
    devices: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Agent:
    """An agent, identified by its own key pair. It is unclaimed until an account claims it.

    Attributes:
        pairing: Changes with each claim; data of earlier pairings are not visible.
        claim_code: Current claim code; empty if claimed.
        leaving: Departures that ``Offboarding`` must clean up.
        expires_ms: When an unclaimed agent may be deleted [ms since 1970].
        labels: Labels set by the owner, by device name. Other devices keep the label of the agent.
    """

    id: str
    name: str
    public_key: str
    software: str
    devices: tuple[DeviceSpec, ...]
    created_ms: int
    account: str | None = None
    space: str | None = None
    pairing: str = ""
    claimed_ms: int = 0
    claim_code: str = ""
    claim_expires_ms: int = 0
    transport: Transport = "mqtt"
    leaving: tuple[Departure, ...] = ()
    expires_ms: int = 0
    labels: dict[str, str] = field(default_factory=dict)

    @property
    def claimed(self) -> bool:
        """Whether an account owns the agent."""
        return self.account is not None

    def device(self, name: str) -> DeviceSpec | None:
        """The device with this name, or ``None``."""
        return next((spec for spec in self.devices if spec.name == name), None)


@dataclass(frozen=True, slots=True)
class Device:
    """A device as visible to one account.

    Attributes:
        role: Highest role of the account.
        topic: Prefix of all topics of the device.
        owner: Account of the agent. Its movements and robot types apply, for every caller.
        until_ms: When the role changes [ms since 1970].
        space_role: Role in the whole space; ``None`` for access to this device only.
        agent_key: Public key of the agent.
    """

    id: str
    name: str
    label: str
    kind: str
    robot_type: str
    agent: str
    space: str
    pairing: str
    role: Role
    topic: str
    transport: Transport = "mqtt"
    owner: str = ""
    until_ms: int = NEVER_MS
    space_role: Role | None = None
    agent_key: str = ""

    @property
    def streaming(self) -> bool:
        """Whether setpoints reach the device: a broker cannot deliver them to an agent that polls over HTTP."""
        return self.transport != "http"


def claim(agent: Agent, *, account: str, space: str, pairing: str, now_ms: int) -> Agent:
    """The agent, claimed by ``account``. The claim code is consumed."""
    return replace(
        agent,
        account=account,
        space=space,
        pairing=pairing,
        claimed_ms=now_ms,
        claim_code="",
        claim_expires_ms=0,
        expires_ms=NEVER_MS,
        labels={},
    )


def rename(agent: Agent, name: str, label: str | None) -> Agent:
    """The agent with a new label for one device; ``None`` restores the agent's own label."""
    others = {other: text for other, text in agent.labels.items() if other != name}
    return replace(agent, labels=others if label is None else {**others, name: label})


def unpair(agent: Agent) -> Agent:
    """The agent without an owner."""
    return replace(
        _leaves(agent, "unpaired", [spec.name for spec in agent.devices]),
        account=None,
        space=None,
        pairing="",
        claimed_ms=0,
        claim_code="",
        claim_expires_ms=0,
        labels={},
    )


def transfer(agent: Agent, *, account: str, space: str, pairing: str, now_ms: int) -> Agent:
    """The agent of another account, with a new pairing: no data or shares of the previous owner remain visible."""
    return claim(unpair(agent), account=account, space=space, pairing=pairing, now_ms=now_ms)


def move(agent: Agent, space: str) -> Agent:
    """The agent in another space of the same account, with its data."""
    return replace(_leaves(agent, "moved", [spec.name for spec in agent.devices]), space=space)


def with_devices(agent: Agent, devices: tuple[DeviceSpec, ...]) -> Agent:
    """The agent with the devices that it reports now."""
    names = {spec.name for spec in devices}
    removed = [spec.name for spec in agent.devices if spec.name not in names]
    labels = {name: label for name, label in agent.labels.items() if name in names}
    return replace(_leaves(agent, "removed", removed), devices=devices, labels=labels)


def _leaves(agent: Agent, why: Literal["unpaired", "moved", "removed"], names: list[str]) -> Agent:
    if agent.account is None or agent.space is None or not names:
        return agent
    leaving = Departure(why, agent.account, agent.space, agent.pairing, tuple(names))
    return replace(agent, leaving=(*agent.leaving, leaving)[-_MAX_DEPARTURES:])


@dataclass(frozen=True, slots=True)
class Link:
    """The last reported connection state of an agent.

    Attributes:
        session: Number of the agent's connection; increases with each connection.
        seen_ms: When the cloud received it [ms since 1970, cloud clock].
        polled: The agent uses HTTP polling, so it sends no message when it stops.
        pairing: Pairing of the agent at that time.
        protocol: Lowest and highest version of the wire contract that the agent supports.
        capabilities: Kinds of request that the agent accepts; empty: not reported.
    """

    online: bool
    session: int
    seen_ms: int
    polled: bool = False
    pairing: str = ""
    protocol: tuple[int, int] = (1, 1)
    capabilities: tuple[str, ...] = ()


def newer_link(existing: Link | None, incoming: Link) -> Link | None:
    """The link to store, or ``None`` if ``incoming`` is outdated.

    The will of an old connection may arrive after "online" of a new one: its session number is lower. Within one
    session "offline" is final.
    """
    if existing is None or incoming.session > existing.session or incoming.pairing != existing.pairing:
        return incoming
    if incoming.session < existing.session or (incoming.online and not existing.online):
        return None
    return incoming


@dataclass(frozen=True, slots=True)
class LastState:
    """The newest ``state`` message of a device, and the agent's pairing at that time."""

    state: dict[str, Any]
    seen_ms: int
    pairing: str = ""

    @property
    def ended_epoch(self) -> int:
        """The highest epoch that the device has ended."""
        return int(self.state.get("ended_epoch", 0))


@dataclass(frozen=True, slots=True)
class DeviceEpochs:
    """The highest epochs that a device has reported in its ``state``: seen, and ended. ``pairing``: at that time."""

    seen: int = 0
    ended: int = 0
    pairing: str = ""


def online(link: Link | None, last_seen_ms: int, now_ms: int) -> bool:
    """Whether the agent counts as online."""
    if link is None or not link.online:
        return False
    return now_ms - last_seen_ms <= (POLL_SILENT_MS if link.polled else SILENT_MS)


def polled(existing: Link | None, now_ms: int, pairing: str) -> Link | None:
    """The link to store after a poll, or ``None`` if the last poll was stored recently.

    A poll overrides any earlier "offline".
    """
    recent = existing is not None and now_ms - existing.seen_ms < POLL_MARK_MS and existing.pairing == pairing
    if existing is not None and existing.online and existing.polled and recent:
        return None
    link = existing or Link(online=True, session=0, seen_ms=now_ms)
    return replace(link, online=True, seen_ms=now_ms, polled=True, pairing=pairing)
