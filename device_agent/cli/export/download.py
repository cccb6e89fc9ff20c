"""Downloads the recording of a session from the server."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote, urlsplit

import msgspec
import requests
from msgspec import Struct

from device_agent.cli.export.episodes import Episode
from device_agent.cli.export.errors import ExportError
from device_agent.cli.export.request import Progress

_TIMEOUT_S = 30.0
_BLOCK = 1 << 20
_MB = 1e6


class _SegmentFile(Struct, frozen=True):
    url: str
    sha256: str


class _StoredRecording(Struct, frozen=True):
    segments: tuple[_SegmentFile, ...] = ()
    episodes: tuple[Episode, ...] = ()


class _Session(Struct, frozen=True):
    recording: _StoredRecording | None = None


class _Problem(Struct, frozen=True):
    detail: str = ""


class SessionClient:
    """Client of the HTTP API for the sessions of devices.

    Args:
        server: Base address, ``https://host``.
        key: API key, ``ts_…``.
        ca: The only certificate authority to accept for an ``https`` server; ``None`` uses the machine's.
        progress: Prints the progress.
    """

    def __init__(self, server: str, key: str, ca: Path | None, progress: Progress) -> None:
        parts = urlsplit(server)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise ExportError(f"--server: '{server}' is not an address like https://host")
        if ca is not None and parts.scheme != "https":
            raise ExportError("--ca needs an https server; an http server has no certificate")
        self._base, self._key, self._progress = server.rstrip("/"), key, progress
        self._http = requests.Session()
        self._http.trust_env = ca is None  # otherwise environment variables could replace the CA
        self._verify: bool | str = True if ca is None else str(ca)

    def download(self, device: str, epoch: int, folder: Path) -> tuple[Episode, ...]:
        """Store the segments of a session in ``folder``; returns its marked episodes.

        Raises:
            ExportError: The server cannot be reached, rejects the key, or has no recording of this session.
        """
        recording = self._recording(device, epoch)
        for number, segment in enumerate(recording.segments):
            text = f"segment {number + 1} of {len(recording.segments)}"
            content = hashlib.sha256()
            with (folder / f"{number:06d}.mcap").open("wb") as file:
                for block in self._blocks(segment.url, text):
                    file.write(block)
                    content.update(block)
            if content.hexdigest() != segment.sha256:
                raise ExportError(f"{text} differs from what the agent has uploaded; try again")
        return recording.episodes

    def _recording(self, device: str, epoch: int) -> _StoredRecording:
        path = f"/api/v1/devices/{quote(device, safe='')}/sessions/{epoch}"
        with self._get(f"{self._base}{path}", {"Authorization": f"Bearer {self._key}"}) as response:
            try:
                session = msgspec.json.decode(response.content, type=_Session)
            except msgspec.MsgspecError as error:
                raise ExportError(f"{self._base} returns no session: {error}; is it a Telescope server?") from error
        if session.recording is None or not session.recording.segments:
            raise ExportError(
                f"the server has no recording of {device} in epoch {epoch}: recording may be off, the agent may not "
                "have uploaded it yet, or it was deleted"
            )
        return session.recording

    def _blocks(self, url: str, text: str) -> Iterator[bytes]:
        # The URL contains its own permission, so the key is not sent.
        with self._get(url, {}) as response:
            received = 0
            try:
                for block in response.iter_content(_BLOCK):
                    received += len(block)
                    self._progress.show(f"{text}: {received / _MB:.0f} MB")
                    yield block
            except requests.RequestException as error:
                raise ExportError(f"the connection was lost at {text}; try again") from error

    def _get(self, url: str, headers: dict[str, str]) -> requests.Response:
        try:
            response = self._http.get(url, headers=headers, timeout=_TIMEOUT_S, stream=True, verify=self._verify)
        except requests.RequestException as error:
            raise ExportError(f"{urlsplit(url).netloc} cannot be reached; check --server and the network") from error
        if response.ok:
            return response
        with response:
            try:
                detail = msgspec.json.decode(response.content, type=_Problem).detail
            except msgspec.MsgspecError:
                detail = ""
            raise ExportError(f"the server rejects the request: {detail or response.reason or response.status_code}")


def read_key(path: Path) -> str:
    """The API key in a file.

    Raises:
        ExportError: The file cannot be read or is empty.
    """
    try:
        key = path.read_text(encoding="ascii").strip()
    except FileNotFoundError as error:
        raise ExportError(f"{path} does not exist; store an API key in it, which the console creates") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ExportError(f"{path} cannot be read as an API key") from error
    if not key:
        raise ExportError(f"{path} is empty; store an API key in it, which the console creates")
    return key
