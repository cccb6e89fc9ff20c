"""How the server listens."""

import asyncio
import socket

import pytest

from function_app.entrypoints.hosts.uvicorn import PortTaken, listen


def test_answers_leave_at_once_on_every_accepted_connection() -> None:
    """Nagle's algorithm and the client's delayed acknowledgement together cost 40 ms an answer."""

    async def accepted() -> int:
        found: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        async def serve(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            opened = writer.get_extra_info("socket")
            found.set_result(opened.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        server = await asyncio.start_server(serve, sock=listen("127.0.0.1", 0))
        async with server:
            _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
            try:
                return await asyncio.wait_for(found, 10)
            finally:
                writer.close()
                await writer.wait_closed()

    assert asyncio.run(accepted())


def test_a_taken_port_is_one_sentence_that_says_what_to_set() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(PortTaken, match=rf"127\.0\.0\.1:{port} .*TELESCOPE_PORT"):
            listen("127.0.0.1", port)
