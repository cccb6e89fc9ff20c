"""Servers of the other transports, each in its own process, which prints ``ready`` when it accepts requests.

``python -m benchmarks.papers.relays web PORT``: stores and returns the newest message over HTTP, for a polling robot;
it also confirms every user that an XMPP server verifies. ``… socket PORT``: parses each JSON message over WebSocket
and sends it to all other clients.
"""

import asyncio
import json
import sys
from typing import Any

from benchmarks.baseline.echo_servers import HOST, serve

LIFETIME_S = 3600


async def _web(port: int) -> None:
    from fastapi import FastAPI, Request

    app = FastAPI()
    newest: dict[str, Any] = {}

    @app.put("/messages/{name}")
    async def put(name: str, request: Request) -> dict[str, bool]:
        newest[name] = await request.json()
        return {"stored": True}

    @app.get("/messages/{name}")
    async def get(name: str) -> Any:
        return newest.get(name)

    @app.post("/verify")
    async def verify(request: Request) -> dict[str, Any]:
        user = (await request.json())["user"]
        return {"user": user, "name": user, "kind": user, "lifetime_s": LIFETIME_S, "contacts": []}

    await serve(app, port)


async def _socket(port: int) -> None:
    from websockets.asyncio.server import ServerConnection
    from websockets.asyncio.server import serve as listen

    clients: set[ServerConnection] = set()

    async def relay(connection: ServerConnection) -> None:
        clients.add(connection)
        try:
            async for text in connection:
                message = json.dumps(json.loads(text))
                for other in clients - {connection}:
                    await other.send(message)
        finally:
            clients.discard(connection)

    async with listen(relay, HOST, port, compression=None) as server:
        print("ready", flush=True)
        await server.serve_forever()


def main(kind: str, port: str) -> None:
    """Serves until the process is terminated."""
    asyncio.run(_web(int(port)) if kind == "web" else _socket(int(port)))


if __name__ == "__main__":
    main(*sys.argv[1:])
