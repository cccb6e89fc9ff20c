"""Where tables, blobs and signing keys are stored, and for how long data is kept."""

import re
from dataclasses import dataclass, field

from function_app.settings.environment import Environment, SettingsError

_PREFIX = re.compile(r"\A[A-Za-z][A-Za-z0-9]{0,31}\Z")
_CONTAINER = re.compile(r"\A(?=.{3,63}\Z)[a-z0-9]+(-[a-z0-9]+)*\Z")
_TABLE = re.compile(r"\A[A-Za-z0-9_.-]{3,255}\Z")
_BUCKET = re.compile(r"\A(?=.{3,63}\Z)[a-z0-9][a-z0-9.-]*[a-z0-9]\Z")
_SECRET = re.compile(r"\A[A-Za-z0-9-]{1,127}\Z")
_AZURITE_KEY = (
    "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/"  # pragma: allowlist secret
    "K1SZFPTOtr/KBHBeksoGMGw=="  # pragma: allowlist secret
)
_AZURITE = (
    f"DefaultEndpointsProtocol=http;AccountName=devstoreaccount1;AccountKey={_AZURITE_KEY};"
    "BlobEndpoint=http://127.0.0.1:10000/devstoreaccount1;TableEndpoint=http://127.0.0.1:10002/devstoreaccount1"
)
"""Connection string of Azurite with its default ports and its well-known account."""
_KMS_KEY = re.compile(r"\A[A-Za-z0-9:/_-]{0,256}\Z")


@dataclass(frozen=True, slots=True, kw_only=True)
class AzureStore:
    """An Azure storage account, by its connection string or by URLs and a managed identity.

    Attributes:
        connection: Connection string; empty with a managed identity.
        tables_url: URL of the table service.
        blobs_url: URL of the blob service.
        identity: Client id of the managed identity; empty for the identity of the host.
        prefix: Prefix of table names.
        container: Blob container.
    """

    connection: str = field(default="", repr=False)
    tables_url: str = ""
    blobs_url: str = ""
    identity: str = ""
    prefix: str = "telescope"
    container: str = "telescope"


@dataclass(frozen=True, slots=True, kw_only=True)
class AwsStore:
    """A DynamoDB table and an S3 bucket. The SDK finds the credentials: a role, or its own variables.

    ``endpoint``: URL of an emulator; ``None`` for AWS.
    """

    region: str
    bucket: str
    table: str = "telescope"
    endpoint: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyVault:
    """A secret in Azure Key Vault that holds the signing keys. ``identity``: see ``AzureStore``."""

    url: str
    secret: str = "telescope-keys"  # noqa: S105 (a name)
    identity: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SecretsManager:
    """A secret in AWS Secrets Manager that holds the signing keys.

    Attributes:
        kms_key: Id of the KMS key that encrypts a new secret; empty for the account's default key.
        endpoint: URL of an emulator; ``None`` for AWS.
    """

    region: str
    secret: str = "telescope-keys"  # noqa: S105 (a name)
    kms_key: str = ""
    endpoint: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RetentionPeriods:
    """How long data is kept. Hourly and daily aggregates are kept for ever.

    Attributes:
        actions_days: Actions after their end [d].
        uploads_days: Captures after their upload [d].
        raw_hours: Every sample [h]. A sample may arrive late by the same time.
        level_10s_days: Aggregates over 10 s [d].
        level_1min_days: Aggregates over 1 min [d].
        level_10min_days: Aggregates over 10 min [d].
    """

    actions_days: int = 30
    uploads_days: int = 30
    raw_hours: int = 24
    level_10s_days: int = 7
    level_1min_days: int = 90
    level_10min_days: int = 730


@dataclass(frozen=True, slots=True, kw_only=True)
class StorageLimits:
    """Limits of stored data, in megabytes.

    Attributes:
        account_mb: Captures, scripts and robot types of an account.
        device_mb: Captures of a device.
        series_mb: Received measurements of a device in a day.
        min_free_mb: Disk space that captures and measurements leave free, for stores on this machine; also within
            ``max_tables_mb``.
        max_tables_mb: Maximum size of the tables on this machine.
    """

    account_mb: int = 20_000
    device_mb: int = 10_000
    series_mb: int = 10_000
    min_free_mb: int = 500
    max_tables_mb: int = 100_000


def read_store(env: Environment) -> AzureStore | AwsStore | None:
    """The cloud store; ``None`` for files in ``home``."""
    match env.get("TELESCOPE_STORE", "local"):
        case "local":
            return None
        case "azure":
            return _read_azure(env)
        case "aws":
            return _read_aws(env)
        case _:
            raise env.invalid("TELESCOPE_STORE", "local, azure or aws")


def _read_azure(env: Environment) -> AzureStore:
    prefix = env.matching("TELESCOPE_STORAGE_PREFIX", "telescope", _PREFIX, "at most 32 letters and digits")
    container = env.matching(
        "TELESCOPE_STORAGE_CONTAINER", "telescope", _CONTAINER, "3 to 63 lower-case letters, digits and hyphens"
    )
    connection = env.get("TELESCOPE_STORAGE_CONNECTION", "")
    if connection == "UseDevelopmentStorage=true":
        connection = _AZURITE  # the SDKs for Python do not know the short form
    if connection:
        # Never in an error message: it contains a key.
        if not all("=" in part for part in connection.strip("; ").split(";")):
            raise SettingsError(
                "TELESCOPE_STORAGE_CONNECTION is not a connection string; copy it from the storage account's "
                "'Access keys'"
            )
        return AzureStore(connection=connection, prefix=prefix, container=container)
    urls = ("TELESCOPE_STORAGE_TABLES_URL", "TELESCOPE_STORAGE_BLOBS_URL")
    if not all(env.get(name) for name in urls):
        raise SettingsError(
            "TELESCOPE_STORE is azure; set TELESCOPE_STORAGE_CONNECTION to the storage account's connection string, or "
            f"{' and '.join(urls)} to its addresses, to use the functions' managed identity"
        )
    tables_url, blobs_url = (env.url(name, "", ("https",)) for name in urls)
    identity = env.identity("TELESCOPE_STORAGE_IDENTITY")
    return AzureStore(tables_url=tables_url, blobs_url=blobs_url, identity=identity, prefix=prefix, container=container)


def _read_aws(env: Environment) -> AwsStore:
    return AwsStore(
        region=env.region(),
        bucket=env.matching("TELESCOPE_AWS_BUCKET", "", _BUCKET, "the name of an S3 bucket"),
        table=env.matching("TELESCOPE_AWS_TABLE", "telescope", _TABLE, "the name of a DynamoDB table"),
        endpoint=env.aws_endpoint(),
    )


def read_keys(env: Environment) -> KeyVault | SecretsManager | None:
    """The vault of the signing keys; ``None`` for files in ``home``."""

    def secret() -> str:
        what = "letters, digits and hyphens, at most 127"
        return env.matching("TELESCOPE_KEYS_SECRET", "telescope-keys", _SECRET, what)

    match env.get("TELESCOPE_KEYS", "local"):
        case "local":
            return None
        case "azure":
            url = env.url("TELESCOPE_KEYVAULT_URL", "", ("https",))
            identity = env.identity("TELESCOPE_KEYVAULT_IDENTITY")
            return KeyVault(url=url, secret=secret(), identity=identity)
        case "aws":
            kms_key = env.matching("TELESCOPE_KEYS_KMS_KEY", "", _KMS_KEY, "the id, alias or ARN of a KMS key")
            return SecretsManager(region=env.region(), secret=secret(), kms_key=kms_key, endpoint=env.aws_endpoint())
        case _:
            raise env.invalid("TELESCOPE_KEYS", "local, azure or aws")


def read_storage_limits(env: Environment) -> StorageLimits:
    """The limits of stored data."""
    default = StorageLimits()
    return StorageLimits(
        account_mb=env.number("TELESCOPE_MAX_ACCOUNT_MB", default.account_mb, 1, 1_000_000_000),
        device_mb=env.number("TELESCOPE_MAX_DEVICE_MB", default.device_mb, 1, 1_000_000_000),
        series_mb=env.number("TELESCOPE_MAX_SERIES_MB", default.series_mb, 1, 1_000_000_000),
        min_free_mb=env.number("TELESCOPE_MIN_FREE_MB", default.min_free_mb, 0, 1_000_000_000),
        max_tables_mb=env.number("TELESCOPE_MAX_TABLES_MB", default.max_tables_mb, 1, 1_000_000_000),
    )


def read_retention(env: Environment) -> RetentionPeriods:
    """The retention periods."""
    default = RetentionPeriods()
    return RetentionPeriods(
        actions_days=env.number("TELESCOPE_KEEP_ACTIONS_DAYS", default.actions_days, 1, 3650),
        uploads_days=env.number("TELESCOPE_KEEP_UPLOADS_DAYS", default.uploads_days, 1, 36_500),
        raw_hours=env.number("TELESCOPE_KEEP_RAW_HOURS", default.raw_hours, 1, 9600),
        level_10s_days=env.number("TELESCOPE_KEEP_10S_DAYS", default.level_10s_days, 1, 36_500),
        level_1min_days=env.number("TELESCOPE_KEEP_1MIN_DAYS", default.level_1min_days, 1, 36_500),
        level_10min_days=env.number("TELESCOPE_KEEP_10MIN_DAYS", default.level_10min_days, 1, 36_500),
    )
