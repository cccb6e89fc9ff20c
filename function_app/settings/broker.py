"""The MQTT broker, the command bus and the XMPP server."""

import re
from dataclasses import dataclass, replace
from typing import Literal, cast

from function_app.settings.environment import Environment, SettingsError

Broker = Literal["amqtt", "mosquitto", "iot", "eventgrid"]
_ENTRA_ID = re.compile(r"\A[0-9A-Fa-f]{8}(-[0-9A-Fa-f]{4}){3}-[0-9A-Fa-f]{12}\Z")
_AUDIENCE = re.compile(r"\A[!-~]{1,255}\Z")
_IOT_POLICY = re.compile(r"\A[A-Za-z0-9_+=,.@-]{0,128}\Z")
_DOMAIN = re.compile(r"\A(?=.{0,253}\Z)([a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?(\.[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?)*)?\Z")


@dataclass(frozen=True, slots=True, kw_only=True)
class IotBus:
    """AWS IoT Core as the command bus.

    Attributes:
        endpoint: The account's data endpoint.
        policy: IoT policy of agent certificates, if IoT Core is also the broker of agents and browsers.
    """

    region: str
    endpoint: str
    policy: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class EventGridWebhook:
    """Identifies the Event Grid namespace that calls the authentication webhook.

    Attributes:
        tenant: Id of the Entra tenant that issues its tokens.
        audience: Id URI of the application in the tokens' audience.
        caller: Object id of the namespace's managed identity.
    """

    tenant: str
    audience: str
    caller: str


@dataclass(frozen=True, slots=True, kw_only=True)
class EventGridBus:
    """An Event Grid namespace as the command bus.

    Attributes:
        endpoint: URL of the namespace.
        identity: Client id of the managed identity; empty for the identity of the host.
        webhook: Caller of the authentication webhook, if the namespace is also the broker of agents and browsers.
    """

    endpoint: str
    identity: str = ""
    webhook: EventGridWebhook | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Xmpp:
    """The XMPP server.

    Attributes:
        domain: Part after the ``@`` of every address; empty where there is no XMPP server.
        host: Address for agents and for the XMPP gateway.
        port: Port for client connections.
        websocket_url: Address for browsers (RFC 7395); empty: browsers send setpoints over MQTT only.
    """

    domain: str = ""
    host: str = "127.0.0.1"
    port: int = 5222
    websocket_url: str = ""


def read_broker(env: Environment) -> tuple[Broker, IotBus | EventGridBus | None]:
    """The broker, and the command bus where it is not a connection to the broker."""
    broker = env.get("TELESCOPE_BROKER", "amqtt")
    if broker not in {"amqtt", "mosquitto", "iot", "eventgrid"}:
        raise env.invalid("TELESCOPE_BROKER", "amqtt, mosquitto, iot or eventgrid")
    bus = _read_bus(env)
    if broker == "eventgrid":
        bus = _with_webhook(env, bus)
    if broker == "iot" and not (isinstance(bus, IotBus) and bus.policy):
        raise SettingsError(
            "TELESCOPE_BROKER is iot; set TELESCOPE_BUS=iot, and TELESCOPE_IOT_POLICY to the policy of agent "
            "certificates"
        )
    return cast("Broker", broker), bus


def read_xmpp(env: Environment, host: str) -> Xmpp:
    """The XMPP server, by default at ``host``."""
    domain = env.matching("TELESCOPE_XMPP_DOMAIN", "", _DOMAIN, "a domain in lower case")
    websocket_url = _read_xmpp_websocket_url(env)
    if websocket_url and not domain:
        raise SettingsError("TELESCOPE_XMPP_WEBSOCKET_URL is set; set TELESCOPE_XMPP_DOMAIN too")
    return Xmpp(
        domain=domain,
        host=env.host("TELESCOPE_XMPP_HOST", host),
        port=env.port("TELESCOPE_XMPP_PORT", 5222),
        websocket_url=websocket_url,
    )


def _read_xmpp_websocket_url(env: Environment) -> str:
    """The address for browsers. It is part of the content security policy, which names it exactly."""
    name = "TELESCOPE_XMPP_WEBSOCKET_URL"
    if not env.get(name):
        return ""
    url = env.url(name, "", ("wss", "ws"))
    if any(letter in url for letter in "?#@"):
        raise env.invalid(name, "an address without user, query and fragment")
    return url


def _read_bus(env: Environment) -> IotBus | EventGridBus | None:
    match env.get("TELESCOPE_BUS", "mqtt"):
        case "mqtt":
            return None
        case "iot":
            return IotBus(
                region=env.region(),
                endpoint=env.url("TELESCOPE_IOT_ENDPOINT", "", ("https", "http")),
                policy=env.matching("TELESCOPE_IOT_POLICY", "", _IOT_POLICY, "the name of an IoT policy"),
            )
        case "eventgrid":
            return EventGridBus(
                endpoint=env.url("TELESCOPE_EVENTGRID_ENDPOINT", "", ("https",)),
                identity=env.identity("TELESCOPE_EVENTGRID_IDENTITY"),
            )
        case _:
            raise env.invalid("TELESCOPE_BUS", "mqtt, iot or eventgrid")


def _with_webhook(env: Environment, bus: IotBus | EventGridBus | None) -> EventGridBus:
    if not isinstance(bus, EventGridBus):
        raise SettingsError("TELESCOPE_BROKER is eventgrid; set TELESCOPE_BUS=eventgrid too")
    for name in ("TELESCOPE_MQTT_HOST", "TELESCOPE_MQTT_PORT", "TELESCOPE_WEBSOCKET_URL"):
        if not env.get(name):
            raise SettingsError(f"TELESCOPE_BROKER is eventgrid; set {name} to the value of the namespace")
    names = ("TELESCOPE_EVENTGRID_TENANT", "TELESCOPE_EVENTGRID_AUDIENCE", "TELESCOPE_EVENTGRID_CALLER")
    webhook = EventGridWebhook(
        tenant=env.matching(names[0], "", _ENTRA_ID, "the id of an Entra tenant"),
        audience=env.matching(names[1], "", _AUDIENCE, "the id URI of an application, such as api://…"),
        caller=env.matching(names[2], "", _ENTRA_ID, "the object id of the namespace's managed identity"),
    )
    return replace(bus, webhook=webhook)
