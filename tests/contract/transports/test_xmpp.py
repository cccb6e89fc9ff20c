"""The XMPP transport over Prosody, with a gateway to the cloud."""

import pytest

from device_agent.transports.xmpp.transport import SILENCE_TIMEOUT_S
from tests.contract.transports.agent_suite import AgentSuite
from tests.contract.transports.suite import Spoken, TransportSuite
from tests.harness.cloud.cloud_processes import Ground


class TestXmpp(TransportSuite):
    spoken = Spoken(configuration={"transport": "xmpp"}, endpoint="xmpp", notices_s=SILENCE_TIMEOUT_S)

    @pytest.fixture
    def ground(self, xmpp_ground: Ground) -> Ground:
        return xmpp_ground


class TestAgentOnXmpp(AgentSuite):
    spoken = TestXmpp.spoken

    @pytest.fixture
    def ground(self, xmpp_ground: Ground) -> Ground:
        return xmpp_ground
