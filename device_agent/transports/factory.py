"""The link of an agent: which transport it speaks, put together, and whether its pairing still holds.

A transport is one line of ``_MAKERS``; what it needs is imported only where it is the one that was chosen.
"""

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from device_agent.config.agent_config import AgentConfig
from device_agent.config.client_certificate import OwnCertificate
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import Pairing
from device_agent.ports.transport import Transport
from device_agent.protocol import topics
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.errors import Refused
from device_agent.transports import tls
from device_agent.transports.http import responses
from device_agent.transports.http.client import CloudClient, CloudError

_log = logging.getLogger(__name__)
SOFTWARE = "telescope-agent 0.1.0"


@dataclass(frozen=True, slots=True, kw_only=True)
class Wiring:
    """What a transport is made from.

    Attributes:
        configuration: With the part of ``agent.toml`` that is the transport's own.
        pairing: Whose the agent is.
        membership: Asks the cloud, and notices when it is no longer so.
        open_api: A view of the HTTP API for one thread.
        next_session: The next session number, rising across restarts.
        quiet: Whether a short break of the link would disturb nothing.
        certificate: What a broker may want to see of this agent.
        now_ms: The cloud's time [ms], once it is known.
        listen: Topics of the space's other agents to hear.
    """

    configuration: AgentConfig
    pairing: Pairing
    membership: "PairingMonitor"
    open_api: Callable[[], CloudClient]
    next_session: Callable[[], int]
    quiet: Callable[[], bool]
    certificate: OwnCertificate
    now_ms: Callable[[], float | None]
    listen: tuple[str, ...] = ()

    @property
    def presence_topic(self) -> str:
        """Where the agent's presence goes."""
        return topics.conn(self.pairing.space, self.pairing.agent)


class PairingMonitor:
    """Whether the agent still belongs to the space of its pairing.

    Args:
        pairing: What was true when the agent was built.
        configuration: What the cloud is told of at the first connection, so that whoever edits ``agent.toml`` need not
            enroll again.
        devices: The devices as the cloud is told of them.
        pins: Learn of the cloud's new keys whenever it is asked for something.
    """

    def __init__(
        self, pairing: Pairing, configuration: AgentConfig, devices: list[dict[str, str]], pins: PinnedKeys
    ) -> None:
        self._pairing = pairing
        self._pins = pins
        self._configuration = configuration
        self._devices = devices
        self._introduced = False
        self.outdated = threading.Event()

    def credentials(self, api: CloudClient) -> dict[str, Any]:
        """Broker credentials for this space.

        Raises:
            CloudError: Refused; or they are for another space, in which nothing of this agent would be heard.
            OSError: Not reached.
        """
        given = self._ask(api, api.credentials)
        own = f"{topics.ROOT}/{self._pairing.space}/{self._pairing.agent}/"
        if not all(str(pattern).startswith(own) for pattern in given.get("subscribe", ())):
            raise self._gone("this agent belongs to another space now")
        return given

    def xmpp_credentials(self, api: CloudClient) -> dict[str, Any]:
        """Credentials for the XMPP server.

        Raises:
            CloudError: Refused; or the agent belongs to another space.
            OSError: Not reached.
        """
        given = self._ask(api, api.xmpp_credentials)
        if given.get("space") != self._pairing.space:
            raise self._gone("this agent belongs to another space now")
        return given

    def check(self, api: CloudClient, *, within_s: float = 10.0) -> None:
        """Look whether the pairing holds, if the cloud answers within so long [s].

        Raises:
            CloudError: It does not, or the cloud refuses the agent.
            OSError: Not reached.
        """
        found = self._ask(api, lambda: api.enrollment(within_s=within_s))
        if found.get("state") != "claimed":
            raise self._gone("this agent was un-paired")
        if found.get("space") != self._pairing.space:
            raise self._gone("this agent belongs to another space now")

    def _ask(self, api: CloudClient, call: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        try:
            self._introduce(api)
            given = call()
            self._learn(responses.read(given, responses.News))
        except CloudError as error:
            if error.code == "agent-unclaimed":
                raise self._gone("this agent was un-paired") from error
            # The cloud has forgotten it, or never knew it: an introduction is what it understands then.
            self._introduced = self._introduced and error.code != "unauthorized"
            raise
        return given

    def _learn(self, news: responses.News) -> None:
        """Follow the cloud to its new keys. A link is worth having also where that fails: Stop and what is measured."""
        try:
            self._pins.follow(news.key_statements)
        except Refused as refused:
            _log.error("the cloud's new key is not followed: %s", refused.message)
        self._pins.check(news.signing_key)

    def _introduce(self, api: CloudClient) -> None:
        if self._introduced:
            return
        told = self._configuration
        claim = api.enroll(name=told.name, software=SOFTWARE, transport=told.transport, devices=self._devices)
        if claim.code is not None:
            raise self._gone("this agent was un-paired")
        self._introduced = True

    def _gone(self, message: str) -> CloudError:
        self.outdated.set()
        return CloudError(message)


def pairing_of(claimed: responses.Claimed) -> Pairing:
    """What an agent pins that has been claimed."""
    return Pairing(
        agent=claimed.agent,
        space=claimed.space,
        account=claimed.account.name,
        owner=claimed.account.id,
        keys={key.id: key.public for key in claimed.keys},
        serial=claimed.serial,
        until_ms={key.id: key.until_ms for key in claimed.keys if key.until_ms},
    )


def names() -> tuple[str, ...]:
    """The transports there are."""
    return tuple(_MAKERS)


def make(wiring: Wiring) -> Transport:
    """The transport that ``agent.toml`` names, not yet started.

    Raises:
        ConfigError: There is none of this name.
    """
    name = wiring.configuration.transport
    if name not in _MAKERS:
        raise ConfigError(f"agent.toml: no transport '{name}'; there are: {', '.join(names())}")
    return _MAKERS[name](wiring)


def _mqtt(wiring: Wiring) -> Transport:
    from device_agent.transports.mqtt import BrokerAccess, MqttTransport  # noqa: PLC0415 (only where it is chosen)

    api = wiring.open_api()

    def access() -> BrokerAccess:
        given = responses.read(wiring.membership.credentials(api), responses.MqttCredentials)
        own = None
        if (after_ms := given.tcp.certificate_after_ms) is not None:
            own = wiring.certificate.ready(
                after_ms=after_ms,
                now_ms=wiring.now_ms() or after_ms,
                ask=lambda request: responses.read(api.certificate(request), responses.Certificate).chain,
            )
        return BrokerAccess(
            host=given.tcp.host,
            port=given.tcp.port,
            client_id=given.client_id,
            username=given.username,
            password=given.password,
            subscribe=given.subscribe,
            lifetime_s=given.lifetime_s,
            tls=tls.broker(tls=given.tcp.tls, server=api.server, ca=api.ca, own=own),
        )

    return MqttTransport(
        access=access,
        presence_topic=wiring.presence_topic,
        next_session=wiring.next_session,
        software=SOFTWARE,
        listen=wiring.listen,
        quiet=wiring.quiet,
    )


def _http(wiring: Wiring) -> Transport:
    from device_agent.transports.http.transport import LONG_POLL_S, HttpTransport  # noqa: PLC0415

    if wiring.listen:
        _log.warning("HTTP brings nothing of the room: interlocks on %s always act", ", ".join(wiring.listen))
    polling = wiring.configuration.http
    return HttpTransport(
        open_api=wiring.open_api,
        check=wiring.membership.check,
        presence_topic=wiring.presence_topic,
        next_session=wiring.next_session,
        software=SOFTWARE,
        quiet=wiring.quiet,
        wait_s=LONG_POLL_S if polling.poll == "long" else 0.0,
        pause_s=0.0 if polling.poll == "long" else polling.poll_ms / 1000,
    )


def _xmpp(wiring: Wiring) -> Transport:
    try:
        from device_agent.transports.xmpp import XmppAccess, XmppTransport  # noqa: PLC0415 (only where it is chosen)
    except ImportError as error:
        raise ConfigError("agent.toml: transport 'xmpp' needs slixmpp; run `pip install slixmpp`") from error
    from device_agent.protocol.xmpp.stream import Login  # noqa: PLC0415

    api = wiring.open_api()

    def access() -> XmppAccess:
        given = responses.read(wiring.membership.xmpp_credentials(api), responses.XmppCredentials)
        login = Login(host=given.host, port=given.port, jid=given.jid, password=given.password)
        return XmppAccess(login=login, cloud=given.cloud, lifetime_s=given.lifetime_s)

    return XmppTransport(
        access=access,
        presence_topic=wiring.presence_topic,
        next_session=wiring.next_session,
        software=SOFTWARE,
        listen=wiring.listen,
        quiet=wiring.quiet,
    )


_MAKERS: Mapping[str, Callable[[Wiring], Transport]] = {"mqtt": _mqtt, "http": _http, "xmpp": _xmpp}
