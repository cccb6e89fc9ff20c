"""Script policy: a device runs only unmodified, signed scripts that are not older than a version that ran."""

import hashlib
from collections.abc import Mapping

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from device_agent.protocol import SHIPPED, RunMovement
from device_agent.protocol.errors import SignatureError
from device_agent.protocol.security import signing
from device_agent.runtime.errors import Refused
from device_agent.runtime.storage.journal import Journal


class ScriptPolicy:
    """Checks of one device for scripts, in addition to those of their commands."""

    def __init__(
        self, *, device: str, robot_type: str, owner: str, keys: Mapping[str, Ed25519PublicKey], journal: Journal
    ) -> None:
        self._device = device
        self._robot_type = robot_type
        self._owner = owner
        self._keys = keys
        self._journal = journal

    def verify(self, request: RunMovement) -> None:
        """Check a script before it runs.

        Raises:
            Refused: Modified, not signed, of another robot type, or older than a version that ran here.
        """
        if request.robot_type != self._robot_type:
            raise Refused("wrong_type", f"a movement of '{request.robot_type}', not of '{self._robot_type}'")
        if hashlib.sha256(request.source.encode()).hexdigest() != request.sha256:
            raise Refused("wrong_hash", "the script does not match its hash; save the movement again")
        self._verify_signature(request)
        highest = self._journal.movement(self._device, request.author, request.robot_type, request.name)
        if request.version < highest:
            raise Refused(
                "rolled_back",
                f"version {request.version} of '{request.name}' is older than version {highest}, which has run on this "
                "device; save the script again, which gives it a new version",
            )

    def record_version(self, request: RunMovement) -> None:
        """Journal the version of a script that starts; older versions are rejected from now on."""
        self._journal.save_movement(self._device, request.author, request.robot_type, request.name, request.version)

    def is_untrusted(self, request: RunMovement) -> bool:
        """Whether the author is neither the agent's owner nor the Telescope project."""
        return request.author not in {SHIPPED, self._owner} or not request.author

    def _verify_signature(self, request: RunMovement) -> None:
        key = self._keys.get(request.key)
        if key is None:
            raise Refused("bad_signature", "the movement is not signed with a pinned key; save it again")
        text = signing.movement_text(request.robot_type, request.name, request.version, request.sha256)
        try:
            signing.verify_text(text, request.signature, key, context=signing.MOVEMENT_CONTEXT)
        except SignatureError as error:
            raise Refused("bad_signature", "the movement does not match its signature; save it again") from error
