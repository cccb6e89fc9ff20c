"""Integrity of uploaded robot types: a signature proves that the validated files are the used ones."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from device_agent.protocol import codec
from device_agent.protocol.errors import SignatureError
from device_agent.protocol.manifests import package
from device_agent.protocol.manifests.package import RobotTypePackage
from device_agent.protocol.security import signing
from function_app.domain.common.problems import Problem
from function_app.domain.robot_types.robot_types import Seal, TypeHead, TypeVersion
from function_app.ports.signing_keys import SigningKeys

_CONTEXT = b"telescope/v1/robot-type\n"


class IntegritySeals:
    """Signs uploads and verifies them."""

    def __init__(self, *, keys: SigningKeys) -> None:
        self._keys = keys

    async def sealed(
        self, account: str, robot_type: str, upload: TypeVersion, files: Mapping[str, bytes]
    ) -> TypeVersion:
        """The upload with a signature over its place, version, manifest and file hashes."""
        key = await self._keys.current()
        hashes = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        text = _text(account, robot_type, upload.version, upload.manifest, hashes)
        signature = signing.sign_text(text, key, context=_CONTEXT)
        return replace(upload, seal=Seal(signing.key_id(key.public_key()), signature, hashes))

    async def package(self, agent: str, robot_type: str, version: int, files: Mapping[str, bytes]) -> bytes:
        """The signed statement about these files for one agent."""
        hashes = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        stated = RobotTypePackage(agent=agent, type=robot_type, version=version, files=hashes)
        return signing.sign(codec.encode(stated), await self._keys.current(), context=package.CONTEXT)

    async def check(self, account: str, robot_type: str, stored: TypeHead | TypeVersion) -> Seal:
        """The seal, if it is valid for this manifest.

        Raises:
            Problem: ``robot-type-damaged``.
        """
        version = stored.ready if isinstance(stored, TypeHead) else stored.version
        seal = stored.seal
        key = (await self._keys.archive()).get(seal.key)
        if key is None:
            raise _damaged(robot_type, "was signed with an unknown or leaked key")
        text = _text(account, robot_type, version, stored.manifest, seal.hashes)
        try:
            signing.verify_text(text, seal.signature, key, context=_CONTEXT)
        except SignatureError as error:
            raise _damaged(robot_type, "differs from the upload") from error
        return seal


def require_intact(robot_type: str, seal: Seal, name: str, content: bytes) -> None:
    """Check that a file equals the uploaded one.

    Raises:
        Problem: ``robot-type-damaged``.
    """
    if seal.hashes.get(name) != hashlib.sha256(content).hexdigest():
        raise _damaged(robot_type, f"has a file that was changed in the store: {name}")


def _text(account: str, robot_type: str, version: int, manifest: Mapping[str, Any], hashes: Mapping[str, str]) -> str:
    fields = {"account": account, "type": robot_type, "version": version, "manifest": manifest, "files": hashes}
    return json.dumps(fields, sort_keys=True, separators=(",", ":"))


def _damaged(robot_type: str, how: str) -> Problem:
    detail = f"The robot type '{robot_type}' {how}. Upload it again."
    return Problem("robot-type-damaged", 409, "The robot type cannot be used", detail)
