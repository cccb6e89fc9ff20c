"""The agent's folder: private key, pairing and lock. It survives restarts and updates.

```
identity.pem     private key, mode 0600; never leaves the machine
agent.toml       server, transport and devices: ``agent_config``
server-ca.pem    certificate authority of the server, if ``enroll --ca`` pinned one
pairing.json     space, account and pinned keys; written before a new key is trusted
device.crt/.key  client certificate: ``client_certificate``
journal.db       commands, epochs and the Stop latch
outbox.db        messages that are not sent yet
recordings/      recordings of sessions: ``runtime.recording.folder``
running.lock     held by the running agent: two agents must not move one robot
```
"""

import contextlib
import logging
import os
import sqlite3
import ssl
import stat
from collections.abc import Iterator
from pathlib import Path

import msgspec
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from msgspec import Struct

from device_agent.config import private_file, release
from device_agent.config.errors import ConfigError
from device_agent.protocol import Id
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.fields import Milliseconds
from device_agent.protocol.security import private_folder, signing
from device_agent.protocol.security.key_rotation import Serial

SERVER_CA = "server-ca.pem"
_log = logging.getLogger(__name__)


class Pairing(Struct, frozen=True, kw_only=True):
    """``pairing.json``: the result of the claim.

    Attributes:
        agent: Id of the agent.
        space: Id of its space.
        account: Display name of the owner.
        keys: Pinned keys of the cloud: key id → public key.
        owner: Account id of the owner. Scripts of other accounts are untrusted.
        serial: Serial number of the newest key; it never decreases.
        until_ms: Expiry of superseded keys: key id → the cloud's clock [ms].
        format: Format of the file; see ``release.PAIRING_FORMAT``.
    """

    agent: Id
    space: Id
    account: str
    keys: dict[str, str]
    owner: str = ""
    serial: Serial = 1
    until_ms: dict[str, Milliseconds] = {}
    format: int = release.WRITTEN["pairing.json"]

    def public_keys(self) -> dict[str, Ed25519PublicKey]:
        """The pinned keys, parsed."""
        return {name: signing.public_key(text) for name, text in self.keys.items()}


class IdentityStore:
    """Reads and writes the agent's folder, which the first write creates. The constructor does not access the disk."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.journal = folder / "journal.db"
        self.outbox = folder / "outbox.db"
        self.faults = folder / "faults"
        self.recordings = folder / "recordings"
        self.robot_types = folder / "robot_types"
        self._pairing = folder / "pairing.json"

    def private_key(self, *, create: bool = False) -> Ed25519PrivateKey:
        """The agent's private key; with ``create`` generated if it is missing.

        Raises:
            ConfigError: The key is missing, unreadable or of another kind.
        """
        path = self.folder / "identity.pem"
        if create and not path.exists():
            generated = signing.generate()
            pem = generated.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
            private_file.write(path, pem)
            return generated
        try:
            _restrict_access(path)
            key = serialization.load_pem_private_key(path.read_bytes(), None)
        except FileNotFoundError as error:
            raise ConfigError(f"{self.folder} holds no agent; run `python -m device_agent enroll` first") from error
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path} cannot be read as a private key: {error}") from error
        if not isinstance(key, Ed25519PrivateKey):
            raise ConfigError(f"{path} is not an Ed25519 key")
        return key

    def certificate_authority(self, file_name: str) -> Path | None:
        """Path of the pinned certificate authority, ``ca`` of ``agent.toml``, or ``None`` if that is empty.

        Raises:
            ConfigError: The file is missing.
        """
        if not file_name:
            return None
        path = self.folder / file_name
        if not path.is_file():
            raise ConfigError(f"{path}, the `ca` of agent.toml, is missing; provide it again with `enroll --ca`")
        return path

    def pin_certificate_authority(self, source: Path) -> str:
        """Copy the certificate of an authority into the folder; returns its file name for ``agent.toml``.

        Raises:
            ConfigError: The source cannot be read, or is not a certificate.
        """
        try:
            content = source.read_bytes()
            ssl.create_default_context(cadata=content.decode())
        except (OSError, ValueError) as error:
            raise ConfigError(f"--ca: {source} cannot be read as a certificate: {error}") from error
        private_file.write(self.folder / SERVER_CA, content)
        return SERVER_CA

    def pairing(self) -> Pairing | None:
        """The pairing, or ``None`` if the agent is not claimed.

        Raises:
            ConfigError: The file is damaged.
        """
        path = self._pairing
        try:
            content = path.read_bytes()
            if release.pairing_format(content) > release.PAIRING_FORMAT:
                raise ConfigError(f"{path} was written by a newer release; use that release")
            pairing = msgspec.json.decode(content, type=Pairing)
            pairing.public_keys()
        except FileNotFoundError:
            return None
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError, ProtocolError) as error:
            raise ConfigError(f"{path}: {error}; delete it and enroll again") from error
        return pairing

    def save_pairing(self, pairing: Pairing | None) -> None:
        """Write the pairing, or remove it.

        Raises:
            ConfigError: The file cannot be written.
        """
        if pairing is None:
            self._pairing.unlink(missing_ok=True)
        else:
            private_file.write(self._pairing, msgspec.json.encode(pairing))

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the exclusive right to run this agent until the end of the ``with`` block or of the process.

        Removes the access of other users to the folder.

        An SQLite lock behaves the same on every operating system and is released when its process ends.

        Raises:
            ConfigError: Another process runs the agent, or the folder holds no agent.
        """
        if not self.folder.is_dir():
            raise ConfigError(f"{self.folder} holds no agent; run `python -m device_agent enroll` first")
        path = self.folder / "running.lock"
        with contextlib.ExitStack() as stack:
            try:
                database = sqlite3.connect(path, timeout=0, isolation_level=None)
                stack.enter_context(contextlib.closing(database)).execute("BEGIN EXCLUSIVE")
            except sqlite3.Error as error:
                if "locked" in str(error):
                    raise ConfigError(
                        f"another process already runs the agent of {self.folder}; stop it first"
                    ) from error
                raise ConfigError(f"{path} cannot be written: {error}") from error
            private_folder.restrict(self.folder, advice="delete identity.pem and enroll again")
            yield


def _restrict_access(path: Path) -> None:
    """Remove the rights of other users. Windows has no such mode bits: there the folder's permissions apply."""
    mode = stat.S_IMODE(path.stat().st_mode)
    if os.name != "nt" and mode & (stat.S_IRWXG | stat.S_IRWXO):
        path.chmod(stat.S_IRUSR | stat.S_IWUSR)
        _log.warning(
            "%s was readable by other users of this machine (mode %03o); the mode is corrected. If another user may "
            "have read the key, delete it and enroll again",
            path,
            mode,
        )
