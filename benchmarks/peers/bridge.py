"""The rosbridge protocol between WebSocket clients, without ROS behind it: ``subscribe`` and ``publish``.

A real rosbridge_server turns each message into ROS's own and passes it on through ROS's own network; that is left out,
in its favour. As there, the text is parsed and written anew, Nagle's algorithm is off and nothing is compressed.
"""

import asyncio
import contextlib

import msgspec
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from benchmarks.baseline.echo_servers import HOST


class Bridge:
    """Who has subscribed to what."""

    def __init__(self) -> None:
        self._subscribers: dict[str, set[ServerConnection]] = {}

    async def serve(self, client: ServerConnection) -> None:
        """One client, until it leaves."""
        with contextlib.suppress(ConnectionClosed):
            async for text in client:
                await self._take(client, msgspec.json.decode(text))
        for each in self._subscribers.values():
            each.discard(client)

    async def _take(self, client: ServerConnection, message: dict[str, object]) -> None:
        topic = str(message.get("topic"))
        if message["op"] == "subscribe":
            self._subscribers.setdefault(topic, set()).add(client)
        elif message["op"] == "publish":
            told = msgspec.json.encode({"op": "publish", "topic": topic, "msg": message["msg"]})
            for each in tuple(self._subscribers.get(topic, ())):
                await each.send(told, text=True)


async def run(port: int) -> None:
    """Until it is ended."""
    async with serve(Bridge().serve, HOST, port, compression=None) as server:
        print("ready", flush=True)
        await server.serve_forever()


def main(port: int) -> None:
    """Of a process of its own."""
    asyncio.run(run(port))
