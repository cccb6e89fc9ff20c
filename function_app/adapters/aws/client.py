"""Clients of AWS services. Each adapter has one client with its own thread pool, created at the first call.

The SDK is also imported at the first call: the import takes a third of a second and would slow down a cold start.
"""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, TypeVar

from function_app.ports.tables import StoreError

if TYPE_CHECKING:
    from botocore.exceptions import ClientError

THREADS = 16
"""Maximum number of concurrent calls; further calls wait."""
ATTEMPTS = 3
"""Maximum number of attempts of the SDK per call."""
CONNECT_TIMEOUT_S = 3
READ_TIMEOUT_S = 10

_MISSING = frozenset({"ResourceNotFoundException", "NoSuchBucket"})
_ACCESS_DENIED = frozenset(
    {
        "403",
        "AccessDenied",
        "AccessDeniedException",
        "ExpiredToken",
        "ExpiredTokenException",
        "ForbiddenException",
        "IncompleteSignature",
        "InvalidAccessKeyId",
        "InvalidSignatureException",
        "MissingAuthenticationTokenException",
        "SignatureDoesNotMatch",
        "UnauthorizedException",
        "UnrecognizedClientException",
    }
)
_THROTTLED = frozenset(
    {"ProvisionedThroughputExceededException", "RequestLimitExceeded", "SlowDown", "ThrottlingException"}
)

T = TypeVar("T")


class ServiceError(StoreError):
    """The service responded with an error. The text states the cause and the remedy in one line.

    Attributes:
        code: The error code of the service.
        reasons: The error code of each write of a transaction.
        retried: Whether the SDK sent the request more than once, so that an earlier attempt may have succeeded.
    """

    def __init__(self, message: str, *, code: str, reasons: tuple[str, ...] = (), retried: bool = False) -> None:
        super().__init__(message)
        self.code = code
        self.reasons = reasons
        self.retried = retried


class Client:
    """The client of one service. Allows concurrent calls; connects at the first call."""

    def __init__(
        self,
        service: str,
        *,
        resource: str,
        setting: str,
        creation: str,
        region: str,
        endpoint: str | None,
        endpoint_setting: str = "",
    ) -> None:
        """Open no connection.

        Args:
            service: The service name in the SDK.
            resource: The resource, for error messages: ``the S3 bucket 'telescope'``.
            setting: The setting that names the resource, for error messages.
            creation: How to create a missing resource, for error messages.
            region: The AWS region.
            endpoint: The address of an emulator; ``None`` for the public endpoint of AWS.
            endpoint_setting: The setting that holds ``endpoint`` if it is not an emulator.
        """
        self._service = service
        self._resource = f"{resource} in {region}" + ("" if endpoint is None else f" at {endpoint}")
        self._setting = setting
        self._creation = creation
        self._region = region
        self._endpoint = endpoint
        self._endpoint_setting = endpoint_setting or (
            "TELESCOPE_AWS_REGION" if endpoint is None else "TELESCOPE_AWS_ENDPOINT"
        )
        self._lock = threading.Lock()
        self._client: Any = None
        self._threads: ThreadPoolExecutor | None = None

    async def call(self, operation: str, **parameters: Any) -> dict[str, Any]:
        """Call an operation of the SDK and return its response, including a streamed body.

        Raises:
            ServiceError: The service responded with an error.
            StoreError: The service cannot be used.
        """

        def send(client: Any) -> dict[str, Any]:
            response: dict[str, Any] = getattr(client, operation)(**parameters)
            if "Body" in response:
                response["Body"] = response["Body"].read()
            return response

        return await self._in_thread(send)

    async def presign(self, operation: str, *, lifetime_s: int, **parameters: Any) -> str:
        """A presigned URL for an operation of the SDK.

        Raises:
            StoreError: There are no credentials to sign it.
        """

        def sign(client: Any) -> str:
            url: str = client.generate_presigned_url(operation, Params=parameters, ExpiresIn=lifetime_s)
            return url

        return await self._in_thread(sign)

    async def close(self) -> None:
        """Close connections and threads. A later call reopens them."""
        threads, self._threads = self._threads, None
        if threads is not None:
            await asyncio.to_thread(threads.shutdown)
        client, self._client = self._client, None
        if client is not None:
            client.close()

    async def _in_thread(self, operation: Callable[[Any], T]) -> T:
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix=self._service)
        return await asyncio.get_running_loop().run_in_executor(self._threads, self._run, operation)

    def _run(self, operation: Callable[[Any], T]) -> T:
        """Run an operation and translate exceptions of the SDK."""
        from botocore import exceptions as sdk  # noqa: PLC0415 (see the module docstring)

        try:
            return operation(self._open())
        except sdk.ClientError as error:
            raise self._service_error(error) from error
        except (
            sdk.CredentialRetrievalError,
            sdk.NoCredentialsError,
            sdk.PartialCredentialsError,
            sdk.TokenRetrievalError,
        ) as error:
            raise StoreError(
                f"{self._resource} cannot be used: {_line(error)}. Give this program a role, or set AWS_ACCESS_KEY_ID "
                "and AWS_SECRET_ACCESS_KEY."
            ) from error
        except (sdk.ConnectionError, sdk.HTTPClientError) as error:
            raise StoreError(
                f"{self._resource} cannot be reached: {_line(error)}. Check {self._endpoint_setting} and the network."
            ) from error
        except sdk.BotoCoreError as error:
            raise StoreError(f"{self._resource} cannot be used: {_line(error)}. Check its configuration.") from error

    def _service_error(self, error: "ClientError") -> ServiceError:
        response: dict[str, Any] = error.response
        code = str(response.get("Error", {}).get("Code", ""))
        reasons = tuple(str(each.get("Code")) for each in response.get("CancellationReasons", ()))
        codes = {code, *reasons}
        if codes & _MISSING:
            text = (
                f"does not exist. Check {self._setting} and TELESCOPE_AWS_REGION, or create it with "
                f"`python -m function_app prepare` ({self._creation})."
            )
        elif codes & _ACCESS_DENIED:
            text = f"denied access: {_line(error)}. Check the credentials and the permissions of their role."
        elif codes & _THROTTLED:
            text = f"is overloaded: {_line(error)}. Try again, or raise its limits."
        else:
            text = f"cannot be used: {_line(error)}. Check its configuration."
        retried = bool(response.get("ResponseMetadata", {}).get("RetryAttempts"))
        return ServiceError(f"{self._resource} {text}", code=code, reasons=reasons, retried=retried)

    def _open(self) -> Any:
        from botocore.config import Config  # noqa: PLC0415
        from botocore.session import Session  # noqa: PLC0415

        with self._lock:
            if self._client is None:
                self._client = Session().create_client(
                    self._service,
                    region_name=self._region,
                    endpoint_url=self._endpoint,
                    config=Config(
                        connect_timeout=CONNECT_TIMEOUT_S,
                        read_timeout=READ_TIMEOUT_S,
                        retries={"mode": "standard", "total_max_attempts": ATTEMPTS},
                        max_pool_connections=THREADS,
                        tcp_keepalive=True,
                        # The default signature of presigned URLs does not cover the length of the upload.
                        signature_version="s3v4" if self._service == "s3" else None,
                        # Without the region in the host name, S3 redirects presigned URLs. Emulators have one host.
                        s3={"addressing_style": "virtual" if self._endpoint is None else "path"},
                    ),
                )
            return self._client


def _line(error: Exception) -> str:
    return " ".join(str(error).split()).rstrip(".")


def iot_data_client(region: str, endpoint: str) -> Client:
    """The client of the IoT Core data plane: messages and connections."""
    return Client(
        "iot-data",
        resource="AWS IoT Core",
        setting="TELESCOPE_IOT_ENDPOINT",
        creation="aws iot describe-endpoint --endpoint-type iot:Data-ATS",
        region=region,
        endpoint=endpoint,
        endpoint_setting="TELESCOPE_IOT_ENDPOINT",
    )
