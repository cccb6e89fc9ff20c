"""Sends latency samples of ``runtime.telemetry.latency_probe`` to the cloud."""

from collections.abc import Callable, Sequence

from device_agent.transports.http.client import CloudClient


class LatencyReports:
    """Reports latency samples of one agent, whose transport is ``mqtt``, ``http``, ``http-poll`` or ``xmpp``.

    ``open_api`` creates a client for exclusive use.
    """

    def __init__(self, agent: str, transport: str, open_api: Callable[[], CloudClient]) -> None:
        self._agent = agent
        self._transport = transport
        self._open_api = open_api
        self._api: CloudClient | None = None

    def send(self, device: str, samples: Sequence[tuple[int, float]]) -> None:
        """Send samples of a device: time [ms since 1970] and latency [ms].

        Raises:
            CloudError: The cloud rejects the request.
            OSError: The cloud cannot be reached.
        """
        api = self._api = self._api or self._open_api()
        report = {"device": device, "transport": self._transport, "path": "device-cloud"}
        points = [{"at_ms": at_ms, "ms": ms} for at_ms, ms in samples]
        api.post(f"/agents/{self._agent}/latency", {**report, "samples": points})
