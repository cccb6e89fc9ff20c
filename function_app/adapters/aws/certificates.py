"""Certificates of agents by AWS IoT Core, which is their authority itself: each belongs to the agent's thing there."""

import contextlib

from function_app.adapters.aws import iot_policies
from function_app.adapters.aws.client import Client, Refused
from function_app.adapters.shared import csr
from function_app.ports.broker_access import BrokerAccessError
from function_app.ports.certificates import Issued
from function_app.ports.tables import StoreError

_MISSING = "ResourceNotFoundException"
_EXISTS = "ResourceAlreadyExistsException"


class IotCertificates:
    """``Certificates`` in AWS IoT Core.

    ``prepare`` makes the agents' IoT policies, whose names begin with ``policy``. They refer to the thing that a
    certificate belongs to: its name is the agent's id, its attribute ``space`` the agent's space.
    """

    wanted = True

    def __init__(self, *, region: str, policy: str, endpoint: str | None = None) -> None:
        self._policy = policy
        self._region = region
        self._caller = Client(
            "sts", what="AWS STS", setting="AWS_REGION", how="it is always there", region=region, endpoint=endpoint
        )
        self._client = Client(
            "iot",
            what="AWS IoT Core",
            setting="TELESCOPE_IOT_POLICY",
            how="aws iot create-policy",
            region=region,
            endpoint=endpoint,
        )

    async def issue(self, agent: str, request: str) -> Issued:
        from cryptography import x509  # noqa: PLC0415 (only where certificates are in use)

        csr.read(request)
        try:
            made = await self._client.call(
                "create_certificate_from_csr", certificateSigningRequest=request, setAsActive=False
            )
            await self._client.call("attach_thing_principal", thingName=agent, principal=made["certificateArn"])
            for name in self._policies(""):
                await self._client.call("attach_policy", policyName=name, target=made["certificateArn"])
            # Last: an interrupted run leaves a certificate without access.
            await self._client.call("update_certificate", certificateId=made["certificateId"], newStatus="ACTIVE")
        except StoreError as error:
            raise _access_error(error) from error
        chain = str(made["certificatePem"])
        ends = x509.load_pem_x509_certificate(chain.encode()).not_valid_after_utc
        return Issued(chain, int(ends.timestamp() * 1000))

    async def place(self, agent: str, space: str) -> None:
        try:
            with contextlib.suppress(Refused):  # it is there, or the next call says what is wrong
                await self._client.call("create_thing", thingName=agent)
            await self._client.call(
                "update_thing", thingName=agent, attributePayload={"attributes": {"space": space}, "merge": True}
            )
        except StoreError as error:
            raise _access_error(error) from error

    async def prepare(self) -> None:
        """Make the policies of agents, or bring them up to date. Safe to repeat.

        Raises:
            BrokerAccessError: They cannot be made.
        """
        try:
            account = (await self._caller.call("get_caller_identity"))["Account"]
            for name, document in self._policies(f"arn:aws:iot:{self._region}:{account}").items():
                try:
                    await self._client.call("create_policy", policyName=name, policyDocument=document)
                except Refused as error:
                    if error.code != _EXISTS:
                        raise
                    await self._renew(name, document)
        except StoreError as error:
            raise _access_error(error) from error

    async def _renew(self, name: str, document: str) -> None:
        """IoT Core keeps five versions of a policy; older ones than the present say nothing any more."""
        known = (await self._client.call("get_policy", policyName=name)).get("policyDocument")
        if known == document:
            return
        versions = await self._client.call("list_policy_versions", policyName=name)
        for version in versions["policyVersions"]:
            if not version["isDefaultVersion"]:
                await self._client.call("delete_policy_version", policyName=name, policyVersionId=version["versionId"])
        await self._client.call("create_policy_version", policyName=name, policyDocument=document, setAsDefault=True)

    def _policies(self, place: str) -> dict[str, str]:
        return {f"{self._policy}-{number}": text for number, text in enumerate(iot_policies.agents(place=place))}

    async def revoke(self, agent: str) -> None:
        try:
            found = await self._client.call("list_thing_principals", thingName=agent)
            for arn in found["principals"]:
                certificate = str(arn).rpartition("/")[2]
                await self._client.call("update_certificate", certificateId=certificate, newStatus="REVOKED")
        except StoreError as error:
            if not isinstance(error, Refused) or error.code != _MISSING:  # it never had one
                raise _access_error(error) from error

    async def close(self) -> None:
        await self._client.close()
        await self._caller.close()


def _access_error(error: StoreError) -> BrokerAccessError:
    return BrokerAccessError(str(error).rstrip("."))
