"""Robot types that the agent has downloaded from its cloud, one folder each as under ``robots/``."""

import hashlib
import re
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from device_agent.config.errors import ConfigError
from device_agent.protocol import codec
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import package, robot_type
from device_agent.protocol.manifests.package import RobotTypePackage
from device_agent.protocol.security import signing

_STATEMENT = "statement.json"
_NAME = re.compile(r"\A([A-Za-z0-9_-][A-Za-z0-9_.-]{0,60}/){0,3}[A-Za-z0-9_-][A-Za-z0-9_.-]{0,60}\Z")


class RobotTypeStore:
    """Verifies and stores robot types.

    Args:
        folder: Contains one folder for each type.
        agent: Id of this agent.
        keys: Pinned keys of the cloud.
    """

    def __init__(self, folder: Path, *, agent: str, keys: Mapping[str, Ed25519PublicKey]) -> None:
        self._folder = folder
        self._agent = agent
        self._keys = keys

    def version(self, name: str) -> int:
        """The stored version; 0 if there is none."""
        try:
            statement = (self._folder / name / _STATEMENT).read_bytes()
            return codec.decode(bytes(codec.decode(statement, signing.Signed).body), RobotTypePackage).version
        except (OSError, ProtocolError):
            return 0

    def install(self, name: str, statement: bytes, files: Mapping[str, bytes]) -> bool:
        """Store a robot type; returns whether it differs from the stored version. The exchange is atomic.

        Raises:
            ConfigError: Signature, hashes or manifest are wrong, or the version is older than the stored one.
        """
        try:
            body = signing.verify(statement, self._keys, context=package.CONTEXT)
            stated = codec.decode(body, RobotTypePackage)
        except ProtocolError as error:
            raise _rejected(name, str(error)) from error
        if (stated.agent, stated.type) != (self._agent, name):
            raise _rejected(name, "its signature is for another agent or robot type")
        stored = self.version(name)
        if stated.version < stored:
            raise _rejected(name, f"version {stated.version} is older than version {stored}, which is stored here")
        hashes = {each: hashlib.sha256(content).hexdigest() for each, content in files.items()}
        if hashes != stated.files or robot_type.MANIFEST not in files or not all(map(_NAME.match, files)):
            raise _rejected(name, "its files do not match the signed hashes")
        if stated.version == stored:
            return False
        try:
            self._exchange(name, {**files, _STATEMENT: statement})
        except OSError as error:
            raise ConfigError(f"robot type '{name}' cannot be stored in {self._folder}: {error.strerror}") from error
        return True

    def _exchange(self, name: str, files: Mapping[str, bytes]) -> None:
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.TemporaryDirectory(dir=self._folder, prefix=".new-") as temporary:
            new, target = Path(temporary) / name, self._folder / name
            for each, content in files.items():
                path = new / each
                path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                path.write_bytes(content)
            try:
                manifest = robot_type.load(new)
            except ProtocolError as error:
                raise _rejected(name, str(error)) from error
            if manifest.type != name:
                raise _rejected(name, f"its manifest describes '{manifest.type}'")
            if target.exists():
                shutil.move(target, Path(temporary) / "old")
            new.rename(target)


def _rejected(name: str, reason: str) -> ConfigError:
    return ConfigError(f"robot type '{name}' from the cloud is rejected: {reason}. Save the robot type again")
