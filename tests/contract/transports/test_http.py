"""The HTTP transport with long and with plain polls."""

import pytest

from device_agent.config.agent_config import HttpPolling
from device_agent.transports.http.transport import SILENCE_TIMEOUT_S
from tests.contract.transports.agent_suite import AgentSuite
from tests.contract.transports.suite import Spoken, TransportSuite


class TestLongPolls(TransportSuite):
    spoken = Spoken(configuration={"transport": "http"}, endpoint="server", notices_s=SILENCE_TIMEOUT_S)


class TestPlainPolls(TransportSuite):
    spoken = Spoken(
        configuration={"transport": "http", "http": HttpPolling(poll="plain", poll_ms=100)},
        endpoint="server",
        notices_s=SILENCE_TIMEOUT_S,
    )


class TestAgentOnLongPolls(AgentSuite):
    spoken = TestLongPolls.spoken


@pytest.mark.long
class TestAgentOnPlainPolls(AgentSuite):
    spoken = TestPlainPolls.spoken
