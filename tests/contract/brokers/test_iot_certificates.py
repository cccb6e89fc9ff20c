"""Agent certificates of AWS IoT Core, emulated by moto."""

import asyncio
from collections.abc import Iterator
from typing import Any

import pytest
from botocore.session import Session
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from function_app.adapters.aws.certificates import IotCertificates
from function_app.ports.broker_access import BrokerAccessError
from function_app.ports.certificates import CertificateRefused
from tests.harness.stores.aws import REGION, start_moto, use_credentials

POLICY, AGENT = "telescope-agents", "agentaaaaa"


def client(endpoint: str) -> Any:
    return Session().create_client("iot", region_name=REGION, endpoint_url=endpoint)


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with start_moto() as endpoint, pytest.MonkeyPatch.context() as environment:
        use_credentials(environment)
        yield endpoint


def request() -> str:
    key = ec.generate_private_key(ec.SECP256R1())
    made = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
    return made.public_bytes(serialization.Encoding.PEM).decode()


def statuses(endpoint: str) -> list[str]:
    iot = client(endpoint)
    principals = iot.list_thing_principals(thingName=AGENT)["principals"]
    ids = [arn.rpartition("/")[2] for arn in principals]
    assert all(iot.list_attached_policies(target=arn)["policies"] for arn in principals)
    return [iot.describe_certificate(certificateId=each)["certificateDescription"]["status"] for each in ids]


def test_each_belongs_to_its_agents_thing_and_ends_with_the_pairing(endpoint: str) -> None:
    async def live() -> None:
        authority = IotCertificates(region=REGION, policy=POLICY, endpoint=endpoint)
        await authority.prepare()
        await authority.prepare()
        await authority.place(AGENT, "spaceone")
        await authority.place(AGENT, "spacetwo")
        assert client(endpoint).describe_thing(thingName=AGENT)["attributes"] == {"space": "spacetwo"}
        issued = await authority.issue(AGENT, request())
        assert issued.chain.startswith("-----BEGIN CERTIFICATE-----")
        await authority.issue(AGENT, request())
        assert statuses(endpoint) == ["ACTIVE", "ACTIVE"]
        await authority.revoke(AGENT)
        await authority.revoke(AGENT)
        await authority.revoke("agentbbbbb")
        assert statuses(endpoint) == ["REVOKED", "REVOKED"]
        with pytest.raises(CertificateRefused):
            await authority.issue(AGENT, "no request")
        await authority.close()

    asyncio.run(live())


def test_a_missing_policy_is_reported(endpoint: str) -> None:
    async def live() -> None:
        authority = IotCertificates(region=REGION, policy="missing", endpoint=endpoint)
        await authority.place("agentccccc", "space")
        with pytest.raises(BrokerAccessError, match="TELESCOPE_IOT_POLICY"):
            await authority.issue("agentccccc", request())
        await authority.close()

    asyncio.run(live())
