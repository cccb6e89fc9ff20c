"""A server of the rosbridge protocol without ROS: ``subscribe`` and ``publish`` between WebSocket clients.

A real rosbridge_server also converts each message and sends it through ROS; this cost is omitted.
As in the original, messages are parsed and serialized again, Nagle's algorithm and compression are disabled.
"""

import asyncio
import contextlib

import msgspec
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from benchmarks.baseline.echo_servers import HOST


class Bridge:
    """Forwards published messages to the subscribed clients."""

    def __init__(self) -> None:
        self._subscribers: dict[str, set[ServerConnection]] = {}

    async def serve(self, client: ServerConnection) -> None:
        """Serves one client until it disconnects."""
        with contextlib.suppress(ConnectionClosed):
            async for text in client:
                await self._handle(client, msgspec.json.decode(text))
        for each in self._subscribers.values():
            each.discard(client)

    async def _handle(self, client: ServerConnection, message: dict[str, object]) -> None:
        topic = str(message.get("topic"))
        if message["op"] == "subscribe":
            self._subscribers.setdefault(topic, set()).add(client)
        elif message["op"] == "publish":
            text = msgspec.json.encode({"op": "publish", "topic": topic, "msg": message["msg"]})
            for each in tuple(self._subscribers.get(topic, ())):
                await each.send(text, text=True)


async def run(port: int) -> None:
    """Serves until the process is terminated."""
    async with serve(Bridge().serve, HOST, port, compression=None) as server:
        print("ready", flush=True)
        await server.serve_forever()


def main(port: int) -> None:
    """Runs the server as a program."""
    asyncio.run(run(port))
