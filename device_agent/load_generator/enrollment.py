"""Registers the simulated agents: each has its own key, is enrolled, and is claimed by code."""

import base64
import time
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path
from typing import TypeVar

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.config import private_file
from device_agent.config.identity_store import Pairing
from device_agent.load_generator.account import Account
from device_agent.load_generator.kinematic_arm import DEVICE
from device_agent.load_generator.options import LoadOptions, LoadTestError
from device_agent.ports.clock import CloudClock
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.security import signing
from device_agent.transports import pairing_monitor
from device_agent.transports.backoff import BackOff
from device_agent.transports.http import responses
from device_agent.transports.http.client import CloudClient, CloudError

T = TypeVar("T")
_ATTEMPTS = 8
FILE = "keys.json"


class Keys:
    """The private keys of all agents of all runs, in one file that only the user can read."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE

    def first(self, count: int) -> list[Ed25519PrivateKey]:
        """The first ``count`` keys; missing ones are generated and saved.

        Raises:
            LoadTestError: The file is not a key file.
            ConfigError: The file cannot be written.
            OSError: The file cannot be read.
        """
        keys = self._read()
        missing = count - len(keys)
        if missing > 0:
            keys += [signing.generate().private_bytes_raw() for _ in range(missing)]
            private_file.write(self._path, msgspec.json.encode([base64.b64encode(key).decode() for key in keys]))
        return [Ed25519PrivateKey.from_private_bytes(key) for key in keys[:count]]

    def _read(self) -> list[bytes]:
        if not self._path.exists():
            return []
        try:
            return [
                base64.b64decode(text, validate=True)
                for text in msgspec.json.decode(self._path.read_bytes(), type=list[str])
            ]
        except ValueError as error:
            raise LoadTestError(f"{self._path} is not a key file of the load generator; use another --home") from error


class Enrollment:
    """Enrolls and claims agents. Blocks; runs in a thread pool."""

    def __init__(self, options: LoadOptions, robot_type: RobotType, clock: CloudClock) -> None:
        self._options = options
        self._robot_type = robot_type
        self._clock = clock
        self._account = Account(options.cloud, sign_in=options.sign_in, token=options.token, ca=options.ca)

    def client(self, key: Ed25519PrivateKey) -> CloudClient:
        """HTTP API client of one agent."""
        return CloudClient(self._options.cloud, key, self._clock, ca=self._options.ca)

    def enroll_all(self, keys: list[Ed25519PrivateKey], pool: Executor, report: Callable[[str], None]) -> list[Pairing]:
        """Pairings of all agents.

        Raises:
            LoadTestError: No account is configured, or the server rejects a claim.
            CloudError: The server rejects an enrollment.
            OSError: The server cannot be reached.
        """
        pairings, reported_s = [], time.monotonic()
        pending = [pool.submit(self._enroll, number, key) for number, key in enumerate(keys, start=1)]
        try:
            for number, future in enumerate(pending, start=1):
                pairings.append(future.result())
                if time.monotonic() - reported_s > self._options.every_s:
                    reported_s = time.monotonic()
                    report(f"{number} of {len(keys)} agents are enrolled")
        finally:
            for future in pending:
                future.cancel()
        self._account.close()
        return pairings

    def _enroll(self, number: int, key: Ed25519PrivateKey) -> Pairing:
        client = self.client(key)
        device = {
            "name": DEVICE,
            "kind": self._robot_type.kind,
            "robot_type": self._robot_type.type,
            "label": f"Arm {number}",
        }
        claim = _with_retry(
            lambda: client.enroll(
                name=f"load-{number:05d}", software=pairing_monitor.SOFTWARE, transport="mqtt", devices=[device]
            )
        )
        if claim.code is not None:
            self._account.claim(claim.code)
        return pairing_monitor.pairing_of(responses.read(_with_retry(client.enrollment), responses.Claimed))


def _with_retry(call: Callable[[], T]) -> T:
    """Retry while the server is overloaded.

    Raises:
        CloudError: The server rejects the request, or remains overloaded.
        OSError: The server cannot be reached.
    """
    back_off = BackOff()
    for _ in range(_ATTEMPTS):
        back_off.attempt()
        try:
            return call()
        except CloudError as error:
            if not error.passing:
                raise
            time.sleep(back_off.wait_s())
        except TimeoutError:
            time.sleep(back_off.wait_s())
    return call()
