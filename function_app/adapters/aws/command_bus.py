"""Publishes commands over the HTTPS API of AWS IoT Core. Acks arrive by an IoT rule."""

from function_app.adapters.aws.client import iot_data_client
from function_app.adapters.shared.publishing_bus import PublishingBus
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import StoreError


class IotCommandBus(PublishingBus):
    """``CommandBus`` over ``iot-data``. Connects at the first message."""

    def __init__(self, *, region: str, endpoint: str) -> None:
        super().__init__("AWS IoT Core")
        self._client = iot_data_client(region, endpoint)

    async def close(self) -> None:
        await self._client.close()

    async def _publish(self, topic: str, payload: bytes, qos: int, retain: bool) -> None:
        try:
            await self._client.call("publish", topic=topic, qos=qos, retain=retain, payload=payload)
        except StoreError as error:
            raise BusUnavailable(str(error).rstrip(".")) from error
