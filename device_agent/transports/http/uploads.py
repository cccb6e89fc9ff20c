"""``Uploads`` over HTTP: asks the functions for an address, sends the content there, and registers it."""

import hashlib
import threading
from collections.abc import Callable
from urllib.parse import urljoin

import requests

from device_agent.ports.uploads import UploadError
from device_agent.transports.http.client import CloudClient, CloudError

_WITHIN_S = 60.0


class HttpUploads:
    """The captures of one agent.

    Args:
        agent: Its id.
        open_api: A view of the HTTP API, with which nobody else calls.
    """

    def __init__(self, agent: str, open_api: Callable[[], CloudClient]) -> None:
        self._agent = agent
        self._open_api = open_api
        self._api: CloudClient | None = None
        self._turn = threading.Lock()

    def store(self, device: str, *, stream: str, name: str, media_type: str, content: bytes, at_ms: int) -> str:
        """See ``Uploads``."""
        path = f"/agents/{self._agent}/uploads"
        announced = {
            "device": device,
            "stream": stream,
            "name": name,
            "content_type": media_type,
            "length": len(content),
            "sha256": hashlib.sha256(content).hexdigest(),
            "at_ms": at_ms,
        }
        with self._turn:
            try:
                api = self._api = self._api or self._open_api()
                begun = api.post(path, announced)
                upload = str(begun["id"])
                url = urljoin(api.server, str(begun["url"]))
                # The pinned authority speaks for the server alone, not for a cloud's store of blobs.
                verify = str(api.ca) if api.ca is not None and url.startswith(api.server) else True
                _send(str(begun["method"]), url, dict(begun["headers"]), content, verify)
                api.post(f"{path}/{upload}/complete", {"device": device})
            except (CloudError, OSError) as error:
                raise UploadError(f"the capture could not be stored: {error}") from error
            except (KeyError, TypeError, ValueError) as error:
                raise UploadError(f"the cloud's answer to an upload lacks {error}") from error
        return upload


def _send(method: str, url: str, headers: dict[str, str], content: bytes, verify: str | bool) -> None:
    """What the address asks for. No token of ours goes with it, and no password of a ``.netrc`` either."""
    try:
        answer = requests.request(
            method,
            url,
            data=content,
            headers=headers,
            auth=_as_it_is,
            timeout=_WITHIN_S,
            allow_redirects=False,
            verify=verify,
        )
    except requests.RequestException as error:
        raise OSError(f"the blob store cannot be reached: {error}") from error
    if not answer.ok:
        raise UploadError(f"the blob store answered {answer.status_code}: {answer.text[:200]}")


def _as_it_is(request: requests.PreparedRequest) -> requests.PreparedRequest:
    return request
