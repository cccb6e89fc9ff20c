"""XMPP, over Prosody, with a program beside it that speaks for the cloud."""

from collections.abc import Iterator

import pytest

from device_agent.transports.xmpp.transport import SILENCE_TIMEOUT_S
from tests.contract.transports.agent_suite import AgentSuite
from tests.contract.transports.suite import Spoken, TransportSuite
from tests.harness.cloud.cloud_processes import Ground
from tests.harness.network.xmpp import start_xmpp_ground


@pytest.fixture(scope="module")
def xmpp_ground(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ground]:
    with start_xmpp_ground(tmp_path_factory.mktemp("xmpp")) as ground:
        yield ground


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
