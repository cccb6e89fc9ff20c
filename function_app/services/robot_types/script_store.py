"""Blob store of movement scripts, signed when saved and verified before use."""

import hashlib
from collections import OrderedDict
from dataclasses import replace

from device_agent.protocol.errors import SignatureError
from device_agent.protocol.security import signing
from function_app.domain.common.problems import Problem
from function_app.domain.identity.accounts import Identity
from function_app.domain.robot_types.movements import Movement
from function_app.ports.blobs import Blobs
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Tables
from function_app.services.storage import quota
from function_app.services.storage.quota import StorageQuota

_KEPT = 256


class ScriptStore:
    """Scripts by account, robot type, name, version and hash, so that deletions do not affect other versions."""

    def __init__(self, *, tables: Tables, blobs: Blobs, quota: StorageQuota, keys: SigningKeys) -> None:
        self._tables = tables
        self._blobs = blobs
        self._quota = quota
        self._keys = keys
        self._kept: OrderedDict[str, str] = OrderedDict()

    async def sign(self, robot_type: str, movement: Movement) -> Movement:
        """The movement with a signature over robot type, name, version and hash."""
        key = await self._keys.current()
        signature = signing.sign_text(signed_text(robot_type, movement), key, context=signing.MOVEMENT_CONTEXT)
        return replace(movement, key=signing.key_id(key.public_key()), signature=signature)

    async def put(self, caller: Identity, robot_type: str, movement: Movement, source: str) -> None:
        """Store a script, before the rows that refer to it.

        Raises:
            Problem: ``quota-exceeded``, ``storage-full``.
        """
        name, content = blob_name(caller, robot_type, movement), source.encode()
        await self._quota.reserve(caller.account, name, len(content))
        await self._blobs.put(name, content)

    async def get(self, caller: Identity, robot_type: str, movement: Movement) -> str:
        """A script with valid signature and hash.

        Content is cached by hash, because it never changes.

        Raises:
            Problem: ``movement-damaged``.
        """
        await self._verify(robot_type, movement)
        name = blob_name(caller, robot_type, movement)
        if name in self._kept:
            self._kept.move_to_end(name)
            return self._kept[name]
        source = await self.find(caller, robot_type, movement)
        if source is None:
            raise _damaged(movement, "is missing or was changed in the store")
        self._kept[name] = source
        if len(self._kept) > _KEPT:
            self._kept.popitem(last=False)
        return source

    async def find(self, caller: Identity, robot_type: str, movement: Movement) -> str | None:
        """The script with the movement's hash; ``None`` if it was deleted or changed."""
        content = await self._blobs.get(blob_name(caller, robot_type, movement))
        if content is None or hashlib.sha256(content).hexdigest() != movement.sha256:
            return None
        return content.decode()

    async def delete(self, caller: Identity, robot_type: str, movement: Movement) -> None:
        """Delete a script without rows."""
        name = blob_name(caller, robot_type, movement)
        await self._blobs.delete(name)
        await quota.release(self._tables, caller.account, name)

    async def _verify(self, robot_type: str, movement: Movement) -> None:
        key = (await self._keys.archive()).get(movement.key)
        if key is None:
            raise _damaged(movement, "was signed with an unknown or leaked key")
        try:
            signing.verify_text(
                signed_text(robot_type, movement), movement.signature, key, context=signing.MOVEMENT_CONTEXT
            )
        except SignatureError as error:
            raise _damaged(movement, "differs from the signed script") from error


def signed_text(robot_type: str, movement: Movement) -> str:
    """The signed text of a movement."""
    return signing.movement_text(robot_type, movement.name, movement.version, movement.sha256)


def blob_name(caller: Identity, robot_type: str, movement: Movement) -> str:
    """Blob name of a version's script."""
    return f"movements/{caller.account}/{robot_type}/{movement.name}/{movement.version}-{movement.sha256}.py"


def _damaged(movement: Movement, how: str) -> Problem:
    detail = f"The script of '{movement.name}' {how}. Save it again."
    return Problem("movement-damaged", 409, "The movement cannot be used", detail)
