"""HTTP, with long and with plain polls."""

from device_agent.runtime.home import HttpPolling
from device_agent.transports.http.transport import NOTICED_WITHIN_S
from tests.contract.transports.suite import Spoken, TransportSuite


class TestLongPolls(TransportSuite):
    spoken = Spoken(configuration={"transport": "http"}, endpoint="server", notices_s=NOTICED_WITHIN_S)


class TestPlainPolls(TransportSuite):
    spoken = Spoken(
        configuration={"transport": "http", "http": HttpPolling(poll="plain", poll_ms=100)},
        endpoint="server",
        notices_s=NOTICED_WITHIN_S,
    )
