"""Client certificates of agents, for brokers that require them."""

from function_app.domain.common.problems import Problem, broker_unavailable, invalid
from function_app.domain.devices.devices import Agent
from function_app.ports.broker_access import BrokerAccessError
from function_app.ports.certificates import CertificateRefused, Certificates, Issued
from function_app.services.devices.device_access import require_claimed


class AgentCertificates:
    """Issues certificates to claimed agents."""

    def __init__(self, *, certificates: Certificates) -> None:
        self._certificates = certificates

    async def certify(self, agent: Agent, request: str) -> Issued:
        """Sign a certificate request of the agent.

        Raises:
            Problem: ``agent-unclaimed``; ``certificates-unused``: the broker requires none; ``invalid``: the request is
                not valid; ``broker-unavailable``.
        """
        space = require_claimed(agent)
        if not self._certificates.required:
            detail = "This broker does not use agent certificates."
            raise Problem("certificates-unused", 409, "Certificates are not used", detail)
        try:
            await self._certificates.set_space(agent.id, space)
            return await self._certificates.issue(agent.id, request)
        except CertificateRefused as refused:
            raise invalid(f"request: {refused}.") from refused
        except BrokerAccessError as error:
            raise broker_unavailable(f"{error}.") from error
