"""Tells the cloud how long messages of an agent took, as ``runtime.round_trips`` has measured it."""

from collections.abc import Callable, Sequence

from device_agent.transports.http.client import CloudClient


class HttpLatencies:
    """The samples of one agent.

    Args:
        agent: Its id.
        transport: What carried the messages: ``mqtt``, ``http``, ``http-poll`` or ``xmpp``.
        open_api: A view of the HTTP API, with which nobody else calls.
    """

    def __init__(self, agent: str, transport: str, open_api: Callable[[], CloudClient]) -> None:
        self._agent = agent
        self._transport = transport
        self._open_api = open_api
        self._api: CloudClient | None = None

    def tell(self, device: str, samples: Sequence[tuple[int, float]]) -> None:
        """Tell samples of a device: when [ms since 1970], and how long [ms].

        Raises:
            CloudError: Refused.
            OSError: Not reached.
        """
        api = self._api = self._api or self._open_api()
        api.post(
            f"/agents/{self._agent}/latency",
            {
                "device": device,
                "transport": self._transport,
                "path": "device-cloud",
                "samples": [{"at_ms": at_ms, "ms": ms} for at_ms, ms in samples],
            },
        )
