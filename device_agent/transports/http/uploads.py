"""Uploads over HTTP: requests an upload URL, sends the content there, and registers it."""

import hashlib
import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any
from urllib.parse import urljoin

import requests

from device_agent.ports.uploads import UploadError
from device_agent.transports.http.client import CloudClient, CloudError

# URLs of uploads are a right to write: a token in the path, or a signature in the query.
logging.getLogger("urllib3.connectionpool").addFilter(
    lambda record: "/blobs/" not in record.getMessage() and "?" not in record.getMessage()
)
_WITHIN_S = 60.0


class HttpUploads:
    """Uploads of one agent; ``open_api`` creates a client for exclusive use."""

    def __init__(self, agent: str, open_api: Callable[[], CloudClient]) -> None:
        self._agent = agent
        self._open_api = open_api
        self._api: CloudClient | None = None
        self._lock = threading.Lock()

    def store(self, device: str, *, stream: str, name: str, media_type: str, content: bytes, at_ms: int) -> str:
        """Implements ``Uploads.store``."""
        path = f"/agents/{self._agent}/uploads"
        metadata = {
            "device": device,
            "stream": stream,
            "name": name,
            "content_type": media_type,
            "length": len(content),
            "sha256": hashlib.sha256(content).hexdigest(),
            "at_ms": at_ms,
        }
        with self._lock:
            try:
                api = self._api = self._api or self._open_api()
                created = api.post(path, metadata)
                upload = str(created["id"])
                send(api, created, content)
                api.post(f"{path}/{upload}/complete", {"device": device})
            except (CloudError, OSError) as error:
                raise UploadError(f"the capture could not be stored: {error}") from error
            except (KeyError, TypeError, ValueError) as error:
                raise UploadError(f"the cloud's response to an upload lacks {error}") from error
        return upload


def send(api: CloudClient, request: Mapping[str, Any], content: bytes | Iterable[bytes]) -> None:
    """Send the content to an upload URL, without the agent's token and without ``.netrc`` credentials.

    Args:
        api: Client of the cloud that returned the request.
        request: ``method``, ``url`` and ``headers``.
        content: The content, or an object with ``__len__`` and ``read`` that limits the rate.

    Raises:
        UploadError: The blob store rejects the content.
        OSError: It cannot be reached.
        KeyError: The request is incomplete, and so are other errors of its conversion.
    """
    url = urljoin(api.server, str(request["url"]))
    # The pinned authority applies to the server only, not to a blob store.
    verify = str(api.ca) if api.ca is not None and url.startswith(api.server) else True
    try:
        response = requests.request(
            str(request["method"]),
            url,
            data=content,
            headers=dict(request["headers"]),
            auth=_no_auth,
            timeout=_WITHIN_S,
            allow_redirects=False,
            verify=verify,
        )
    except requests.RequestException as error:
        raise OSError(f"the blob store cannot be reached: {error}") from error
    if not response.ok:
        raise UploadError(f"the blob store responded {response.status_code}: {response.text[:200]}")


def _no_auth(request: requests.PreparedRequest) -> requests.PreparedRequest:
    return request
