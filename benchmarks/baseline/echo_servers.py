"""Echo servers, each in its own process: the minimum that an exchange must contain.

Usage: ``python -m benchmarks.baseline.echo_servers tcp|http PORT`` or
``… mqtt PORT CLIENT USER PASSWORD TOPIC REPLY_TOPIC QOS BYTES``. The program prints ``ready`` when it accepts requests.
Over MQTT the reply is padded to ``BYTES``.
"""

import asyncio
import json
import socket
import sys
from typing import Any

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion

HOST = "127.0.0.1"


def disable_nagle(_client: Any, _userdata: Any, connection: Any) -> None:
    """Disables Nagle's algorithm; paho calls it as ``on_socket_open``."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


async def _tcp(port: int) -> None:
    async def reply(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(65_536):
            writer.write(data)

    async with await asyncio.start_server(reply, HOST, port) as server:
        print("ready", flush=True)
        await server.serve_forever()


async def serve(app: Any, port: int) -> None:
    """Serves an application with uvicorn, as the product does; prints ``ready``."""
    import uvicorn

    config = uvicorn.Config(app, host=HOST, port=port, log_level="error", access_log=False, timeout_keep_alive=600)
    server = uvicorn.Server(config)
    serving = asyncio.create_task(server.serve())
    while not server.started:  # noqa: ASYNC110 (uvicorn offers no event to wait for)
        await asyncio.sleep(0.01)
    print("ready", flush=True)
    await serving


async def _http(port: int) -> None:
    from fastapi import FastAPI, Request, Response

    app = FastAPI()

    @app.post("/echo")
    async def echo(request: Request) -> Response:
        return Response(await request.body(), media_type="application/json")

    @app.get("/echo")
    async def status() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/sized/{length}")
    async def sized(length: int) -> Response:
        return Response(json.dumps("x" * (length - 2)), media_type="application/json")

    await serve(app, port)


def _mqtt(port: int, *arguments: str) -> None:
    client_id, user, password, topic, reply_topic, qos_text, size_text = arguments
    qos, size = int(qos_text), int(size_text)
    client = paho.Client(CallbackAPIVersion.VERSION2, client_id, protocol=paho.MQTTv311)
    client.username_pw_set(user, password)
    client.on_socket_open = disable_nagle

    def reply(_client: paho.Client, _userdata: Any, message: paho.MQTTMessage) -> None:
        client.publish(reply_topic, message.payload.ljust(size), qos)

    def subscribe(*_: Any) -> None:
        client.subscribe(topic, qos)

    client.on_message = reply
    client.on_connect = subscribe
    client.on_subscribe = lambda *_: print("ready", flush=True)
    client.connect(HOST, port, keepalive=60)
    client.loop_forever()


def main(kind: str, port: str, *arguments: str) -> None:
    """Serves until the process is terminated."""
    if kind == "tcp":
        asyncio.run(_tcp(int(port)))
    elif kind == "http":
        asyncio.run(_http(int(port)))
    else:
        _mqtt(int(port), *arguments)


if __name__ == "__main__":
    main(*sys.argv[1:])
