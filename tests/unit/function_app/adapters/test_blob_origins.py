"""The origin of a cloud store, which the console's policy names, is that of the URLs that its SDK signs."""

import asyncio
import re
from functools import cache

import pytest
from azure.storage.blob import ContainerClient
from botocore.session import Session

from function_app.adapters.aws.blobs import S3Blobs
from function_app.adapters.azure.blobs import AzureBlobs
from function_app.adapters.azure.client import Endpoint
from function_app.ports.blobs import origin_of
from tests.harness.stores.aws import use_credentials

KEY = "a2V5"
ACCOUNT = f"AccountName=lab;AccountKey={KEY}"


@cache
def regions() -> tuple[str, ...]:
    """One region of each partition of AWS, and the one that has a host name of its own."""
    session = Session()
    first = [min(session.get_available_regions("s3", each)) for each in session.get_available_partitions()]
    return ("us-east-1", *first)


@pytest.mark.parametrize("bucket", ["lab-store", "lab.store"])
def test_the_origin_of_a_bucket_is_that_of_its_urls(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_credentials(monkeypatch)
    for region in regions():
        blobs = S3Blobs(bucket=bucket, region=region)
        url = asyncio.run(blobs.presign_download("a", content_type="image/png", lifetime_s=60))
        assert blobs.origin == origin_of(url)
        assert blobs.origin.startswith("https://")


@pytest.mark.parametrize(
    "connection",
    [
        f"DefaultEndpointsProtocol=https;{ACCOUNT};EndpointSuffix=core.windows.net",
        f"DefaultEndpointsProtocol=https;{ACCOUNT};EndpointSuffix=core.chinacloudapi.cn",
        f"{ACCOUNT}; BlobEndpoint=https://blobs.lab.example/",
        f"{ACCOUNT};blobendpoint=http://127.0.0.1:10000/lab",
        ACCOUNT,
    ],
)
def test_the_origin_of_a_connection_string_is_that_of_its_urls(connection: str) -> None:
    url = ContainerClient.from_connection_string(re.sub(r"; *", ";", connection), "telescope").url
    assert AzureBlobs(endpoint=Endpoint(connection), container="telescope").origin == origin_of(url)


def test_the_origin_of_an_address_is_that_of_the_blob_service() -> None:
    endpoint = Endpoint(url="https://lab.blob.core.windows.net/")
    assert AzureBlobs(endpoint=endpoint, container="telescope").origin == "https://lab.blob.core.windows.net"
    assert AzureBlobs(endpoint=Endpoint("UseDevelopmentStorage=true"), container="telescope").origin == ""
