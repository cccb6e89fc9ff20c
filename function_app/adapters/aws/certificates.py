"""Agent certificates issued by AWS IoT Core; each is attached to the agent's thing."""

import contextlib

from function_app.adapters.aws import iot_policies
from function_app.adapters.aws.client import Client, ServiceError
from function_app.adapters.shared import csr
from function_app.ports.broker_access import BrokerAccessError
from function_app.ports.certificates import Issued
from function_app.ports.tables import StoreError

_MISSING = "ResourceNotFoundException"
_EXISTS = "ResourceAlreadyExistsException"


class IotCertificates:
    """``Certificates`` in AWS IoT Core.

    ``prepare`` creates the agents' IoT policies, whose names begin with ``policy``. The policies refer to the thing of
    the certificate: its name is the agent's id, and its attribute ``space`` is the agent's space.
    """

    required = True

    def __init__(self, *, region: str, policy: str, endpoint: str | None = None) -> None:
        self._policy = policy
        self._region = region
        self._sts = Client(
            "sts", resource="AWS STS", setting="AWS_REGION", creation="not needed", region=region, endpoint=endpoint
        )
        self._client = Client(
            "iot",
            resource="AWS IoT Core",
            setting="TELESCOPE_IOT_POLICY",
            creation="aws iot create-policy",
            region=region,
            endpoint=endpoint,
        )

    async def issue(self, agent: str, request: str) -> Issued:
        from cryptography import x509  # noqa: PLC0415 (only where certificates are in use)

        csr.read(request)
        try:
            created = await self._client.call(
                "create_certificate_from_csr", certificateSigningRequest=request, setAsActive=False
            )
            await self._client.call("attach_thing_principal", thingName=agent, principal=created["certificateArn"])
            for name in self._policies(""):
                await self._client.call("attach_policy", policyName=name, target=created["certificateArn"])
            # Last: an interrupted run leaves a certificate without access.
            await self._client.call("update_certificate", certificateId=created["certificateId"], newStatus="ACTIVE")
        except StoreError as error:
            raise _access_error(error) from error
        chain = str(created["certificatePem"])
        ends = x509.load_pem_x509_certificate(chain.encode()).not_valid_after_utc
        return Issued(chain, int(ends.timestamp() * 1000))

    async def set_space(self, agent: str, space: str) -> None:
        try:
            with contextlib.suppress(ServiceError):  # it exists, or the next call raises the error
                await self._client.call("create_thing", thingName=agent)
            await self._client.call(
                "update_thing", thingName=agent, attributePayload={"attributes": {"space": space}, "merge": True}
            )
        except StoreError as error:
            raise _access_error(error) from error

    async def prepare(self) -> None:
        """Create or update the policies of agents. Idempotent.

        Raises:
            BrokerAccessError: They cannot be created.
        """
        try:
            account = (await self._sts.call("get_caller_identity"))["Account"]
            for name, document in self._policies(f"arn:aws:iot:{self._region}:{account}").items():
                try:
                    await self._client.call("create_policy", policyName=name, policyDocument=document)
                except ServiceError as error:
                    if error.code != _EXISTS:
                        raise
                    await self._update(name, document)
        except StoreError as error:
            raise _access_error(error) from error

    async def _update(self, name: str, document: str) -> None:
        if (await self._client.call("get_policy", policyName=name)).get("policyDocument") == document:
            return
        # IoT Core stores at most five versions of a policy.
        versions = await self._client.call("list_policy_versions", policyName=name)
        for version in versions["policyVersions"]:
            if not version["isDefaultVersion"]:
                await self._client.call("delete_policy_version", policyName=name, policyVersionId=version["versionId"])
        await self._client.call("create_policy_version", policyName=name, policyDocument=document, setAsDefault=True)

    def _policies(self, arn_prefix: str) -> dict[str, str]:
        texts = iot_policies.agents(arn_prefix=arn_prefix)
        return {f"{self._policy}-{number}": text for number, text in enumerate(texts)}

    async def revoke(self, agent: str) -> None:
        try:
            response = await self._client.call("list_thing_principals", thingName=agent)
            for arn in response["principals"]:
                certificate = str(arn).rpartition("/")[2]
                await self._client.call("update_certificate", certificateId=certificate, newStatus="REVOKED")
        except StoreError as error:
            if not isinstance(error, ServiceError) or error.code != _MISSING:  # it has no certificate
                raise _access_error(error) from error

    async def close(self) -> None:
        await self._client.close()
        await self._sts.close()


def _access_error(error: StoreError) -> BrokerAccessError:
    return BrokerAccessError(str(error).rstrip("."))
