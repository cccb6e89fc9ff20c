"""Connections of the XMPP gateway."""

from function_app.adapters import factory
from function_app.adapters.local.command_feed import MqttCommandFeed
from function_app.adapters.mqtt.connection import Broker, MqttConnection
from function_app.bootstrap import Functions
from function_app.ports.broker_link import Credentials, OnMessage, OpenLink
from function_app.ports.feeds import CommandFeed
from function_app.ports.xmpp_connection import XmppConnection
from function_app.settings import SettingsError


def xmpp_connection(functions: Functions) -> XmppConnection:
    """The gateway's connection to the XMPP server, not yet open.

    Raises:
        SettingsError: The settings name no XMPP server.
    """
    from function_app.adapters.xmpp.connection import SlixmppConnection  # noqa: PLC0415 (loads slixmpp only for the gateway)

    settings = functions.settings
    if not settings.xmpp.domain:
        raise SettingsError("TELESCOPE_XMPP_DOMAIN is empty. Set it to the domain that the XMPP server serves.")

    async def password() -> str:
        return (await functions.xmpp_credentials.cloud()).password

    return SlixmppConnection(
        host=settings.xmpp.host, port=settings.xmpp.port, domain=settings.xmpp.domain, password=password
    )


def command_feed(functions: Functions) -> CommandFeed:
    """The broker's commands for agents that connect through the gateway, not yet subscribed."""
    settings = functions.settings
    return MqttCommandFeed(
        host=settings.mqtt_host, port=settings.mqtt_port, access=functions.access, tls=factory.broker_tls(settings)
    )


def broker_links(functions: Functions) -> OpenLink:
    """Opens broker connections of operators."""
    settings = functions.settings
    tls = factory.broker_tls(settings)

    def open_link(credentials: Credentials, receive: OnMessage) -> MqttConnection:
        broker = Broker(host=settings.mqtt_host, port=settings.mqtt_port, credentials=credentials, tls=tls)
        connection = MqttConnection(
            broker, receive=lambda message: receive(message.topic, bytes(message.payload)), qos=1
        )
        connection.start()
        return connection

    return open_link
