"""XMPP, over Prosody, with a program beside it that speaks for the cloud."""

from collections.abc import Iterator

import pytest

from device_agent.transports.xmpp.transport import NOTICED_WITHIN_S
from tests.contract.transports.agent_suite import AgentSuite
from tests.contract.transports.suite import Spoken, TransportSuite
from tests.support.brokers import HOST
from tests.support.ground import Ground, start_ground
from tests.support.hosts.host import environment_of, start_program
from tests.support.xmpp import DOMAIN, ProsodyEnd, free_port


@pytest.fixture(scope="module")
def xmpp_ground(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ground]:
    folder, port = tmp_path_factory.mktemp("xmpp"), free_port()
    settings = {"TELESCOPE_XMPP_DOMAIN": DOMAIN, "TELESCOPE_XMPP_HOST": HOST, "TELESCOPE_XMPP_PORT": str(port)}
    with start_ground("mosquitto", folder, settings) as ground:
        end = ProsodyEnd(folder / "prosody", f"{ground.url}/api/v1/xmpp/verify", port, ground.stack)
        ground.endpoints["xmpp"] = end
        environment = environment_of({**ground.environment, "TELESCOPE_PORT": str(ground.endpoints["server"].port)})
        ground.stack.enter_context(start_program(["-m", "function_app", "xmpp"], environment))
        yield ground


class TestXmpp(TransportSuite):
    spoken = Spoken(configuration={"transport": "xmpp"}, endpoint="xmpp", notices_s=NOTICED_WITHIN_S)

    @pytest.fixture
    def ground(self, xmpp_ground: Ground) -> Ground:
        return xmpp_ground


class TestAgentOnXmpp(AgentSuite):
    spoken = TestXmpp.spoken

    @pytest.fixture
    def ground(self, xmpp_ground: Ground) -> Ground:
        return xmpp_ground
