"""Agent certificates of AWS IoT Core, emulated by moto."""

from typing import Any

import pytest
from botocore.session import Session
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from function_app.adapters.aws.certificates import IotCertificates
from function_app.ports.broker_access import BrokerAccessError
from function_app.ports.certificates import CertificateRefused
from tests.contract.conftest import Closing
from tests.harness.stores.aws import REGION

POLICY, AGENT = "telescope-agents", "agentaaaaa"

pytestmark = pytest.mark.anyio


def request() -> str:
    key = ec.generate_private_key(ec.SECP256R1())
    request = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
    return request.public_bytes(serialization.Encoding.PEM).decode()


def statuses(iot: Any) -> list[str]:
    """Statuses of the agent's certificates, each with a policy."""
    principals = iot.list_thing_principals(thingName=AGENT)["principals"]
    assert all(iot.list_attached_policies(target=arn)["policies"] for arn in principals)
    ids = [arn.rpartition("/")[2] for arn in principals]
    return [iot.describe_certificate(certificateId=each)["certificateDescription"]["status"] for each in ids]


async def test_certificates_are_attached_to_the_thing_and_revoked(moto: str, closing: Closing) -> None:
    iot = Session().create_client("iot", region_name=REGION, endpoint_url=moto)
    authority = closing(IotCertificates(region=REGION, policy=POLICY, endpoint=moto))
    for _ in range(2):
        await authority.prepare()
    for space in ("spaceone", "spacetwo"):
        await authority.set_space(AGENT, space)
    assert iot.describe_thing(thingName=AGENT)["attributes"] == {"space": "spacetwo"}
    for _ in range(2):
        issued = await authority.issue(AGENT, request())
        assert issued.chain.startswith("-----BEGIN CERTIFICATE-----")
    assert statuses(iot) == ["ACTIVE", "ACTIVE"]
    for agent in (AGENT, AGENT, "agentbbbbb"):
        await authority.revoke(agent)
    assert statuses(iot) == ["REVOKED", "REVOKED"]
    with pytest.raises(CertificateRefused):
        await authority.issue(AGENT, "no request")
    iot.close()


async def test_a_missing_policy_is_reported(moto: str, closing: Closing) -> None:
    authority = closing(IotCertificates(region=REGION, policy="missing", endpoint=moto))
    await authority.set_space("agentccccc", "space")
    with pytest.raises(BrokerAccessError, match="TELESCOPE_IOT_POLICY"):
        await authority.issue("agentccccc", request())
