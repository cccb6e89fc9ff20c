"""The account that claims the simulated agents by their claim codes."""

import threading
import time
from pathlib import Path
from typing import Any

import requests

from device_agent.load_generator.options import LoadTestError

_TIMEOUT_S = 20.0
_ATTEMPTS = 6
_MAX_WAIT_S = 30.0
_UNAUTHORIZED, _TOO_MANY_REQUESTS, _SERVER_ERROR = 401, 429, 500


class Account:
    """Client of the HTTP API for an account. Thread-safe; one request at a time.

    Args:
        server: Base address.
        sign_in: One-time sign-in link, or its part after ``#sign-in=``. It is redeemed at the first request.
        token: Access token; replaces ``sign_in``.
        ca: The only certificate authority to accept for an ``https`` server.
    """

    def __init__(self, server: str, *, sign_in: str = "", token: str = "", ca: Path | None = None) -> None:
        self._base = f"{server.rstrip('/')}/api/v1"
        self._link = sign_in.rpartition("#sign-in=")[2]
        self._token = token
        self._csrf = ""
        self._http = requests.Session()
        self._verify: bool | str = True if ca is None else str(ca)
        self._lock = threading.Lock()

    def claim(self, code: str) -> None:
        """Redeem a claim code.

        Raises:
            LoadTestError: The server rejects the claim, or no account is configured.
            OSError: The server cannot be reached.
        """
        with self._lock:
            self._sign_in()
            self._request("/agents/claim", {"code": code})

    def close(self) -> None:
        """Sign out, if this object has signed in."""
        with self._lock:
            if self._csrf:
                self._post("/auth/sign-out", {})
            self._http.close()

    def _sign_in(self) -> None:
        if self._token:
            return
        if not self._link:
            raise LoadTestError(
                "an account must claim the agents: provide --sign-in with a link from `make link`, "
                "or an access token in TELESCOPE_TOKEN"
            )
        link, self._link = self._link, ""
        session = self._request("/auth/sign-in", {"link": link})
        self._token, self._csrf = str(session["access_token"]), str(session["csrf_token"])

    def _request(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        """Send a request; retries after a 429 or 5xx response."""
        for _ in range(_ATTEMPTS):
            response = self._post(path, body)
            if response.status_code == _UNAUTHORIZED and self._csrf and path != "/auth/token":
                self._token = str(self._request("/auth/token", {})["access_token"])
                continue
            if response.status_code != _TOO_MANY_REQUESTS and response.status_code < _SERVER_ERROR:
                break
            time.sleep(_retry_after_s(response))
        try:
            content = response.json()
        except ValueError as error:
            raise LoadTestError(f"{self._base}{path} did not return JSON: is it a Telescope server?") from error
        if not response.ok or not isinstance(content, dict):
            detail = content.get("detail") if isinstance(content, dict) else None
            raise LoadTestError(f"the server rejects {path}: {detail or response.reason}")
        return content

    def _post(self, path: str, body: dict[str, Any]) -> requests.Response:
        headers = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        if path == "/auth/token":
            headers = {"X-CSRF-Token": self._csrf}
        try:
            return self._http.post(
                self._base + path,
                json=body,
                headers=headers,
                timeout=_TIMEOUT_S,
                allow_redirects=False,
                verify=self._verify,
            )
        except requests.RequestException as error:
            raise OSError(f"{self._base} cannot be reached: {error}") from error


def _retry_after_s(response: requests.Response) -> float:
    value = response.headers.get("Retry-After", "")
    return min(float(value), _MAX_WAIT_S) if value.isdecimal() else 1.0
