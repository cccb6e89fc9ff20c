"""Publishes the results of simulated trials on a server, with an API key."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol
from urllib.parse import quote, urlsplit

import msgspec
import requests
from msgspec import Struct

from device_agent.config.errors import ConfigError
from device_agent.config.release import VERSION
from device_agent.protocol import TrialCause

_TIMEOUT_S = 30.0
_CREATED = 201


class Result(Protocol):
    """Result of one trial, as ``TrialResult``."""

    @property
    def success(self) -> bool:
        """Whether the condition was met."""

    @property
    def lifted(self) -> bool:
        """Whether the robot has lifted the object or moved the part."""

    @property
    def timed_out(self) -> bool:
        """Whether the time limit passed."""

    @property
    def script_error(self) -> str:
        """Error of the script."""


class Version(Struct, frozen=True, kw_only=True):
    """What was tried.

    Attributes:
        tasks_sha256: Hash of the manifest of the tasks (hex).
        movement_sha256: Hash of the movement's script (hex).
        type_version: Version of the robot type.
    """

    tasks_sha256: str
    movement_sha256: str
    type_version: int


class _Batch(Version, frozen=True, kw_only=True):
    first_seed: int
    trials: int
    successes: int
    causes: dict[str, int]
    software: str


class _Problem(Struct, frozen=True):
    detail: str = ""


class Publisher:
    """Client of the HTTP API for batches of trials.

    Args:
        server: Base address, ``https://host``.
        key_file: File with an API key of an operator.
        ca: The only certificate authority to accept; ``None`` uses the machine's.

    Raises:
        ConfigError: The address is wrong, or the file cannot be read.
    """

    def __init__(self, server: str, key_file: Path, ca: Path | None) -> None:
        parts = urlsplit(server)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise ConfigError(f"--publish: '{server}' is not an address like https://host")
        if ca is not None and parts.scheme != "https":
            raise ConfigError("--ca needs an https server; an http server has no certificate")
        try:
            self._key = key_file.read_text(encoding="ascii").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(
                f"{key_file} cannot be read; store an API key in it, which the console creates"
            ) from error
        if not self._key:
            raise ConfigError(f"{key_file} is empty; store an API key in it, which the console creates")
        self._server = server.rstrip("/")
        self._http = requests.Session()
        self._http.trust_env = ca is None  # otherwise environment variables could replace the CA
        self._verify: bool | str = True if ca is None else str(ca)

    def publish(self, task: str, version: Version, first_seed: int, results: Sequence[Result]) -> None:
        """Publish results of trials with consecutive seeds.

        Args:
            task: ``TYPE/TASK``.
            version: What was tried.
            first_seed: Seed of the first trial.
            results: Results in the order of the seeds.

        Raises:
            ConfigError: The server cannot be reached, or rejects them.
        """
        causes = Counter(cause_of(result).value for result in results if not result.success)
        batch = _Batch(
            **msgspec.structs.asdict(version),
            first_seed=first_seed,
            trials=len(results),
            successes=len(results) - causes.total(),
            causes=dict(causes),
            software=VERSION,
        )
        kind, _, name = (quote(part, safe="") for part in task.partition("/"))
        url = f"{self._server}/api/v1/robot-types/{kind}/tasks/{name}/batches"
        headers = {"Authorization": f"Bearer {self._key}", "Content-Type": "application/json"}
        body = msgspec.json.encode(batch)
        try:
            response = self._http.post(url, body, headers=headers, timeout=_TIMEOUT_S, verify=self._verify)
        except requests.RequestException as error:
            host = urlsplit(url).netloc
            raise ConfigError(f"{host} cannot be reached; check --publish and the network") from error
        if response.status_code != _CREATED:
            try:
                detail = msgspec.json.decode(response.content, type=_Problem).detail
            except msgspec.MsgspecError:
                detail = ""
            raise ConfigError(f"the server rejects the results: {detail or response.reason or response.status_code}")


def cause_of(result: Result) -> TrialCause:
    """Why a trial has no success, as an agent reports it."""
    if result.success:
        return TrialCause.NONE
    if result.timed_out:
        return TrialCause.TIME_LIMIT
    if result.script_error:
        return TrialCause.MOVEMENT_FAILED
    return TrialCause.INCOMPLETE if result.lifted else TrialCause.NOT_MET
