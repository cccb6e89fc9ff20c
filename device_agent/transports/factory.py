"""Creates the transport that ``agent.toml`` names. Only the dependencies of that transport are imported."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from device_agent.config.agent_config import AgentConfig
from device_agent.config.client_certificate import ClientCertificate
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import Pairing
from device_agent.ports.transport import Transport
from device_agent.protocol import topics
from device_agent.transports.http import responses
from device_agent.transports.http.client import CloudClient
from device_agent.transports.pairing_monitor import SOFTWARE, PairingMonitor

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Wiring:
    """Everything that transports are created from.

    Attributes:
        configuration: Includes the settings of the transport.
        pairing: Space and account of the agent.
        pairing_monitor: Requests credentials and detects an invalid pairing.
        open_api: Creates a client of the HTTP API for one thread.
        next_session: Next session number; it rises across restarts.
        quiet: Whether a short interruption of the link is harmless now.
        certificate: Client certificate for brokers that require one.
        now_ms: The cloud's time [ms], once known.
        listen: Topics of other agents of the space that the agent subscribes to.
    """

    configuration: AgentConfig
    pairing: Pairing
    pairing_monitor: PairingMonitor
    open_api: Callable[[], CloudClient]
    next_session: Callable[[], int]
    quiet: Callable[[], bool]
    certificate: ClientCertificate
    now_ms: Callable[[], float | None]
    listen: tuple[str, ...] = ()

    @property
    def presence_topic(self) -> str:
        """Topic of the agent's presence."""
        return topics.conn(self.pairing.space, self.pairing.agent)


def names() -> tuple[str, ...]:
    """Names of all transports."""
    return tuple(_MAKERS)


def make(wiring: Wiring) -> Transport:
    """Create the transport that ``agent.toml`` names, not started.

    Raises:
        ConfigError: The name is unknown.
    """
    name = wiring.configuration.transport
    if name not in _MAKERS:
        raise ConfigError(f"agent.toml: unknown transport '{name}'; known: {', '.join(names())}")
    return _MAKERS[name](wiring)


def _mqtt(wiring: Wiring) -> Transport:
    from device_agent.transports.mqtt import BrokerAccess, MqttTransport, broker_access  # noqa: PLC0415 (only if selected)

    api = wiring.open_api()

    def access() -> BrokerAccess:
        credentials = responses.read(wiring.pairing_monitor.credentials(api), responses.MqttCredentials)
        own = None
        if (after_ms := credentials.tcp.certificate_after_ms) is not None:
            own = wiring.certificate.ready(
                after_ms=after_ms,
                now_ms=wiring.now_ms() or after_ms,
                request_chain=lambda request: responses.read(api.certificate(request), responses.Certificate).chain,
            )
        return broker_access(credentials, api, own=own)

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
        _log.warning(
            "the http transport receives no room measurements: interlocks on %s are always engaged",
            ", ".join(wiring.listen),
        )
    polling = wiring.configuration.http
    return HttpTransport(
        open_api=wiring.open_api,
        check=wiring.pairing_monitor.check,
        presence_topic=wiring.presence_topic,
        next_session=wiring.next_session,
        software=SOFTWARE,
        quiet=wiring.quiet,
        wait_s=LONG_POLL_S if polling.poll == "long" else 0.0,
        pause_s=0.0 if polling.poll == "long" else polling.poll_ms / 1000,
    )


def _xmpp(wiring: Wiring) -> Transport:
    try:
        from device_agent.transports.xmpp import XmppAccess, XmppTransport  # noqa: PLC0415 (only if selected)
    except ImportError as error:
        raise ConfigError("agent.toml: transport 'xmpp' needs slixmpp; run `pip install slixmpp`") from error
    from device_agent.protocol.xmpp.stream import Login  # noqa: PLC0415

    api = wiring.open_api()

    def access() -> XmppAccess:
        credentials = responses.read(wiring.pairing_monitor.xmpp_credentials(api), responses.XmppCredentials)
        login = Login(host=credentials.host, port=credentials.port, jid=credentials.jid, password=credentials.password)
        return XmppAccess(login=login, cloud=credentials.cloud, lifetime_s=credentials.lifetime_s)

    return XmppTransport(
        access=access,
        presence_topic=wiring.presence_topic,
        next_session=wiring.next_session,
        software=SOFTWARE,
        listen=wiring.listen,
        quiet=wiring.quiet,
    )


_MAKERS: Mapping[str, Callable[[Wiring], Transport]] = {"mqtt": _mqtt, "http": _http, "xmpp": _xmpp}
