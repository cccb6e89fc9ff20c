"""Ends an MQTT client of the paho library that runs its own thread."""

import asyncio

from paho.mqtt import client as paho


async def close_client(client: paho.Client) -> None:
    """Disconnect, end the client's thread, and close all its sockets.

    paho closes its two wake-up sockets only in its finalizer. The callbacks of a client form reference cycles, so the
    garbage collector may run it much later.
    """
    client.disconnect()
    await asyncio.to_thread(client.loop_stop)
    client._reset_sockets()  # noqa: SLF001 (paho has no public call for this)
