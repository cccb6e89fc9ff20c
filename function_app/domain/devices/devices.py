"""Agents, their devices, and what is known of them at this moment."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from function_app.domain.common.timestamps import NEVER_MS
from function_app.domain.identity.accounts import Role

SILENT_MS = 90_000
"""An agent sends state every 30 s; after three missed ones a last word of "online" is no longer believed."""
POLL_SILENT_MS = 45_000
"""An agent that polls asks at least every 30 s."""
POLL_MARK_MS = 15_000
"""How often at most it is written down that an agent has polled."""

_MOST_LEAVING = 16
"""Only a broker that is away for long lets so many come together; the oldest then keep what is retained of them."""

Transport = Literal["mqtt", "http", "xmpp"]
"""How an agent hears what is addressed to it. Not over MQTT: it, or who speaks XMPP for it, fetches it by HTTP."""


@dataclass(frozen=True, slots=True)
class DeviceSpec:
    """What an agent says about one of its devices when it enrolls."""

    name: str
    kind: str
    robot_type: str
    label: str


@dataclass(frozen=True, slots=True)
class Departure:
    """What was left and is still to be tidied up: whose it was, where, and which devices."""

    why: Literal["unpaired", "moved", "removed"]
    account: str
    space: str
    pairing: str
    devices: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Agent:
    """One identity: a key pair that the agent made itself. Waiting until an account claims it.

    Attributes:
        pairing: Changes with each claim: what belongs to an earlier owner's pairing is no longer shown.
        claim_code: The code that claims it now; empty when claimed.
        leaving: What ``services/leave.py`` has to tidy up.
        expires_ms: From then on it may be forgotten, if nobody has claimed it [ms since 1970].
        labels: What its owner calls its devices, by their names; the others are called as it says itself.
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
        """Whether it belongs to somebody."""
        return self.account is not None

    def device(self, name: str) -> DeviceSpec | None:
        """The device of this name."""
        return next((spec for spec in self.devices if spec.name == name), None)


@dataclass(frozen=True, slots=True)
class Device:
    """One device, as one account may see it.

    Attributes:
        role: The highest that the account has here.
        topic: The first levels of all its topics.
        owner: The account that its agent belongs to; its movements and robot types count here, whoever asks.
        until_ms: When the role changes by itself [ms since 1970].
        space_role: The account's role in the whole space; ``None`` where it has a part in this device alone.
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


def claim(agent: Agent, *, account: str, space: str, pairing: str, now_ms: int) -> Agent:
    """The agent, now of ``account``; its code is used up."""
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
    """The agent with one of its devices called ``label``; ``None``: as it says itself."""
    others = {existing: given for existing, given in agent.labels.items() if existing != name}
    return replace(agent, labels=others if label is None else {**others, name: label})


def unpair(agent: Agent) -> Agent:
    """The agent, of nobody."""
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
    """The agent, from one account to another in one step: it is nobody's at no time.

    A new pairing, as if it had been un-paired and claimed: nothing that was seen, said or shared under the owner before
    goes with it.
    """
    return claim(unpair(agent), account=account, space=space, pairing=pairing, now_ms=now_ms)


def move(agent: Agent, space: str) -> Agent:
    """The agent in another space of its account, with all that is known of its devices."""
    return replace(_leaves(agent, "moved", [spec.name for spec in agent.devices]), space=space)


def with_devices(agent: Agent, devices: tuple[DeviceSpec, ...]) -> Agent:
    """The agent with the devices that it says it has now."""
    names = {spec.name for spec in devices}
    removed = [spec.name for spec in agent.devices if spec.name not in names]
    labels = {name: label for name, label in agent.labels.items() if name in names}
    return replace(_leaves(agent, "removed", removed), devices=devices, labels=labels)


def _leaves(agent: Agent, why: Literal["unpaired", "moved", "removed"], names: list[str]) -> Agent:
    if agent.account is None or agent.space is None or not names:
        return agent
    leaving = Departure(why, agent.account, agent.space, agent.pairing, tuple(names))
    return replace(agent, leaving=(*agent.leaving, leaving)[-_MOST_LEAVING:])


@dataclass(frozen=True, slots=True)
class Link:
    """The last word about an agent's connection.

    Attributes:
        session: Number of the agent's connection; it rises each time.
        seen_ms: When the cloud took notice [ms since 1970, cloud's clock].
        polled: The agent has no connection but asks again and again; nobody says so when it stops.
        pairing: Of the agent then: what was said under an earlier owner is not shown.
    """

    online: bool
    session: int
    seen_ms: int
    polled: bool = False
    pairing: str = ""


def newer_link(existing: Link | None, incoming: Link) -> Link | None:
    """What to store, or ``None`` when the news is old.

    An old connection's will may arrive after the new connection's "online": the lower session number gives it away.
    Within one session "offline" is final.
    """
    if existing is None or incoming.session > existing.session or incoming.pairing != existing.pairing:
        return incoming
    if incoming.session < existing.session or (incoming.online and not existing.online):
        return None
    return incoming


@dataclass(frozen=True, slots=True)
class LastState:
    """The newest ``state`` message of a device, as it came, and the agent's pairing then."""

    state: dict[str, Any]
    seen_ms: int
    pairing: str = ""

    @property
    def ended_epoch(self) -> int:
        """The highest epoch that the device says it never obeys again."""
        return int(self.state.get("ended_epoch", 0))


def online(link: Link | None, last_seen_ms: int, now_ms: int) -> bool:
    """Whether the agent may be believed to be there."""
    if link is None or not link.online:
        return False
    return now_ms - last_seen_ms <= (POLL_SILENT_MS if link.polled else SILENT_MS)


def polled(existing: Link | None, now_ms: int, pairing: str) -> Link | None:
    """What to store when an agent has polled, or ``None`` when that was noted a moment ago.

    Asking is better evidence than any earlier word of "offline".
    """
    created = existing is not None and now_ms - existing.seen_ms < POLL_MARK_MS and existing.pairing == pairing
    if existing is not None and existing.online and existing.polled and created:
        return None
    return Link(online=True, session=existing.session if existing else 0, seen_ms=now_ms, polled=True, pairing=pairing)
