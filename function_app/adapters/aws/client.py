"""How the adapters talk to Amazon: one client each, made at the first call, in threads of its own.

The SDK is imported at the first call too: it takes a third of a second, which the functions' start need not wait for.
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
"""Calls under way at once; more wait for one of them."""
ATTEMPTS = 3
"""How often the SDK tries in all, with its own pauses between."""
CONNECT_TIMEOUT_S = 3
READ_TIMEOUT_S = 10

_MISSING = frozenset({"ResourceNotFoundException", "NoSuchBucket"})
_NO_RIGHTS = frozenset(
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
_TOO_MUCH = frozenset(
    {"ProvisionedThroughputExceededException", "RequestLimitExceeded", "SlowDown", "ThrottlingException"}
)

T = TypeVar("T")


class Refused(StoreError):  # noqa: N818 (an outcome that callers look at)
    """The service refused a request. The text says what it means and what to do, in one line.

    Attributes:
        code: The service's word for why.
        reasons: Of a transaction, the word for each of its writes.
        tried_again: The SDK sent the request more than once: an earlier one may have been obeyed.
    """

    def __init__(self, message: str, *, code: str, reasons: tuple[str, ...] = (), tried_again: bool = False) -> None:
        super().__init__(message)
        self.code = code
        self.reasons = reasons
        self.tried_again = tried_again


class Client:
    """One service as one adapter uses it. Any number of calls at once; opens nothing before the first."""

    def __init__(
        self, service: str, *, what: str, setting: str, how: str, region: str, endpoint: str | None, address: str = ""
    ) -> None:
        """Remember the place.

        Args:
            service: The SDK's name of it.
            what: What is used there, for errors: ``the S3 bucket 'telescope'``.
            setting: The setting that names it, for errors.
            how: How it is to be created when it is not there, for errors.
            region: Amazon's region.
            endpoint: The address of an emulator; ``None`` for Amazon's own.
            address: The setting that holds ``endpoint``, where that is not an emulator's.
        """
        self._service = service
        self._where = f"{what} in {region}" + ("" if endpoint is None else f" at {endpoint}")
        self._setting = setting
        self._how = how
        self._region = region
        self._endpoint = endpoint
        self._address = address or ("TELESCOPE_AWS_REGION" if endpoint is None else "TELESCOPE_AWS_ENDPOINT")
        self._lock = threading.Lock()
        self._client: Any = None
        self._threads: ThreadPoolExecutor | None = None

    async def call(self, operation: str, **parameters: Any) -> dict[str, Any]:
        """The answer to one of the SDK's operations. A body in it has been read.

        Raises:
            Refused: The service refused the request.
            StoreError: The service cannot be used.
        """

        def ask(client: Any) -> dict[str, Any]:
            answer: dict[str, Any] = getattr(client, operation)(**parameters)
            if "Body" in answer:
                answer["Body"] = answer["Body"].read()
            return answer

        return await self._in_thread(ask)

    async def presign(self, operation: str, *, lifetime_s: int, **parameters: Any) -> str:
        """A presigned URL for one of the SDK's operations.

        Raises:
            StoreError: There are no credentials to sign it with.
        """

        def sign(client: Any) -> str:
            url: str = client.generate_presigned_url(operation, Params=parameters, ExpiresIn=lifetime_s)
            return url

        return await self._in_thread(sign)

    async def close(self) -> None:
        """Close connections and threads. A later call opens them again."""
        threads, self._threads = self._threads, None
        if threads is not None:
            await asyncio.to_thread(threads.shutdown)
        client, self._client = self._client, None
        if client is not None:
            client.close()

    async def _in_thread(self, do: Callable[[Any], T]) -> T:
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix=self._service)
        return await asyncio.get_running_loop().run_in_executor(self._threads, self._guarded, do)

    def _guarded(self, do: Callable[[Any], T]) -> T:
        """Do it with the SDK's client, and say what is wrong in our own words."""
        from botocore import exceptions as sdk  # noqa: PLC0415 (see this page's first lines)

        try:
            return do(self._open())
        except sdk.ClientError as error:
            raise self._refusal(error) from error
        except (
            sdk.CredentialRetrievalError,
            sdk.NoCredentialsError,
            sdk.PartialCredentialsError,
            sdk.TokenRetrievalError,
        ) as error:
            raise StoreError(
                f"{self._where} cannot be used: {_line(error)}. Give this program a role, or set AWS_ACCESS_KEY_ID and "
                "AWS_SECRET_ACCESS_KEY."
            ) from error
        except (sdk.ConnectionError, sdk.HTTPClientError) as error:
            raise StoreError(
                f"{self._where} cannot be reached: {_line(error)}. Check {self._address} and the network."
            ) from error
        except sdk.BotoCoreError as error:
            raise StoreError(f"{self._where} cannot be used: {_line(error)}. Check its configuration.") from error

    def _refusal(self, error: "ClientError") -> Refused:
        """What a refusal means and what to do."""
        response: dict[str, Any] = error.response
        code = str(response.get("Error", {}).get("Code", ""))
        reasons = tuple(str(each.get("Code")) for each in response.get("CancellationReasons", ()))
        codes = {code, *reasons}
        if codes & _MISSING:
            text = (
                f"does not exist. Check {self._setting} and TELESCOPE_AWS_REGION, or create it: {self._how}; "
                "`python -m function_app prepare` does."
            )
        elif codes & _NO_RIGHTS:
            text = f"may not be used: {_line(error)}. Check the credentials and the rights of their role."
        elif codes & _TOO_MUCH:
            text = f"has too much to do: {_line(error)}. Try again, or raise its limits."
        else:
            text = f"cannot be used: {_line(error)}. Check its configuration."
        tried_again = bool(response.get("ResponseMetadata", {}).get("RetryAttempts"))
        return Refused(f"{self._where} {text}", code=code, reasons=reasons, tried_again=tried_again)

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
                        # What the SDK signs addresses with otherwise leaves out the length of what is uploaded.
                        signature_version="s3v4" if self._service == "s3" else None,
                        # The region in the host's name, or S3 redirects what was signed. Emulators have one name only.
                        s3={"addressing_style": "virtual" if self._endpoint is None else "path"},
                    ),
                )
            return self._client


def _line(error: Exception) -> str:
    return " ".join(str(error).split()).rstrip(".")


def iot_data_client(region: str, endpoint: str) -> Client:
    """Messages and connections of AWS IoT Core, at the account's address for data."""
    return Client(
        "iot-data",
        what="AWS IoT Core",
        setting="TELESCOPE_IOT_ENDPOINT",
        how="aws iot describe-endpoint --endpoint-type iot:Data-ATS",
        region=region,
        endpoint=endpoint,
        address="TELESCOPE_IOT_ENDPOINT",
    )
