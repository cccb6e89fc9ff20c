"""The XMPP transport over Prosody, with a gateway to the cloud."""

import pytest

from device_agent.transports.xmpp.transport import SILENCE_TIMEOUT_S
from tests.contract.transports.agent_suite import AgentSuite
from tests.contract.transports.suite import Spoken, TransportSuite
from tests.harness.cloud.cloud_processes import CloudProcesses


class TestXmpp(TransportSuite):
    spoken = Spoken(configuration={"transport": "xmpp"}, endpoint="xmpp", notices_s=SILENCE_TIMEOUT_S)

    @pytest.fixture
    def processes(self, xmpp_processes: CloudProcesses) -> CloudProcesses:
        return xmpp_processes


class TestAgentOnXmpp(AgentSuite):
    spoken = TestXmpp.spoken

    @pytest.fixture
    def processes(self, xmpp_processes: CloudProcesses) -> CloudProcesses:
        return xmpp_processes
