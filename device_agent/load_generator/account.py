"""The account that claims the simulated agents by their claim codes."""

import threading
import time
from pathlib import Path
from typing import Any

import requests

from device_agent.load_generator.options import LoadTestError

_WITHIN_S = 20.0
_TRIES = 6
_LONGEST_WAIT_S = 30.0
_UNAUTHORIZED, _BUSY, _SERVER_ERROR = 401, 429, 500


class Account:
    """Client of the HTTP API for an account. Thread-safe; one request at a time.

    Args:
        server: Base address.
        sign_in: A one-time sign-in link, or what stands in it after ``#sign-in=``; used once, when first needed.
        token: An access token, instead.
        ca: The authority that alone may speak for an ``https`` server.
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
            LoadTestError: The server rejects the claim, or there is no session.
            OSError: Not reached.
        """
        with self._lock:
            self._enter()
            self._ask("/agents/claim", {"code": code})

    def close(self) -> None:
        """Sign out, if this object has signed in."""
        with self._lock:
            if self._csrf:
                self._post("/auth/sign-out", {})
            self._http.close()

    def _enter(self) -> None:
        if self._token:
            return
        if not self._link:
            raise LoadTestError(
                "an account must claim the agents: provide --sign-in with a link from `make link`, "
                "or an access token in TELESCOPE_TOKEN"
            )
        link, self._link = self._link, ""
        given = self._ask("/auth/sign-in", {"link": link})
        self._token, self._csrf = str(given["access_token"]), str(given["csrf_token"])

    def _ask(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        """The response; retries after a 429 response."""
        for _ in range(_TRIES):
            answer = self._post(path, body)
            if answer.status_code == _UNAUTHORIZED and self._csrf and path != "/auth/token":
                self._token = str(self._ask("/auth/token", {})["access_token"])
                continue
            if answer.status_code != _BUSY and answer.status_code < _SERVER_ERROR:
                break
            time.sleep(_wait_s(answer))
        try:
            found = answer.json()
        except ValueError as error:
            raise LoadTestError(f"{self._base}{path} responded without JSON: is it a Telescope server?") from error
        if not answer.ok or not isinstance(found, dict):
            detail = found.get("detail") if isinstance(found, dict) else None
            raise LoadTestError(f"the server rejects {path}: {detail or answer.reason}")
        return found

    def _post(self, path: str, body: dict[str, Any]) -> requests.Response:
        headers = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        if path == "/auth/token":
            headers = {"X-CSRF-Token": self._csrf}
        try:
            return self._http.post(
                self._base + path,
                json=body,
                headers=headers,
                timeout=_WITHIN_S,
                allow_redirects=False,
                verify=self._verify,
            )
        except requests.RequestException as error:
            raise OSError(f"{self._base} cannot be reached: {error}") from error


def _wait_s(answer: requests.Response) -> float:
    said = answer.headers.get("Retry-After", "")
    return min(float(said), _LONGEST_WAIT_S) if said.isdecimal() else 1.0
