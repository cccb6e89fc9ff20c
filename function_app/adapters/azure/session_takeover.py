"""Disconnects a client by connecting with its client id: the broker then ends the previous connection (MQTT, 3.1.4)."""

import asyncio
import ssl
from typing import Any

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.reasoncodes import ReasonCode

from function_app.adapters.shared.mqtt_client import close_client
from function_app.ports.broker_access import BrokerAccessError, Credentials

TIMEOUT_S = 10.0
_KEEP_ALIVE_S = 30


class SessionTakeover:
    """Connects with the client id of another client, and disconnects."""

    def __init__(self, *, host: str, port: int, tls: ssl.SSLContext | None) -> None:
        self._host = host
        self._port = port
        self._tls = tls

    async def __call__(self, client_id: str, credentials: Credentials) -> None:
        """Take over and end the session of a client id.

        Raises:
            BrokerAccessError: The broker is not reachable or rejects the connection.
        """
        loop = asyncio.get_running_loop()
        outcome: asyncio.Future[str] = loop.create_future()
        client = paho.Client(
            CallbackAPIVersion.VERSION2,
            client_id=client_id,
            protocol=paho.MQTTv311,
            clean_session=True,
            reconnect_on_failure=False,
        )
        client.username_pw_set(*credentials)
        client.connect_timeout = TIMEOUT_S
        if self._tls is not None:
            client.tls_set_context(self._tls)

        def settle(problem: str) -> None:
            if not outcome.done():
                outcome.set_result(problem)

        def connected(_: Any, __: Any, ___: Any, reason: ReasonCode, ____: Any) -> None:
            loop.call_soon_threadsafe(settle, str(reason) if reason.is_failure else "")

        def disconnected(_: Any, __: Any, ___: Any, reason: ReasonCode, ____: Any) -> None:
            loop.call_soon_threadsafe(settle, f"the connection broke: {reason}")

        client.on_connect, client.on_disconnect = connected, disconnected
        broker = f"the broker at {self._host}:{self._port}"
        try:
            async with asyncio.timeout(TIMEOUT_S):
                await asyncio.to_thread(client.connect, self._host, self._port, _KEEP_ALIVE_S)
                client.loop_start()
                problem = await outcome
        except TimeoutError as error:
            raise BrokerAccessError(f"{broker} did not answer in {TIMEOUT_S:.0f} s") from error
        except OSError as error:
            raise BrokerAccessError(f"{broker} cannot be reached: {error}") from error
        finally:
            await close_client(client)
        if problem:
            raise BrokerAccessError(f"{broker} does not let the functions disconnect {client_id}: {problem}")
