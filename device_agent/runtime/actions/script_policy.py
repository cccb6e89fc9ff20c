"""Which movement scripts a device runs: those that the cloud has signed, unchanged, and never an older one again."""

import hashlib
from collections.abc import Mapping

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from device_agent.protocol import SHIPPED, RunMovement
from device_agent.protocol.errors import SignatureError
from device_agent.protocol.security import signing
from device_agent.runtime.errors import Refused
from device_agent.runtime.storage.journal import Journal


class ScriptPolicy:
    """The judgement of one device about scripts, besides that about the command they came with.

    Args:
        device: Its name.
        robot_type: Id of its robot type.
        owner: Id of the account that the agent is paired with; empty where the pairing does not say.
        keys: The cloud's pinned public keys by key id.
        journal: Open.
    """

    def __init__(
        self, *, device: str, robot_type: str, owner: str, keys: Mapping[str, Ed25519PublicKey], journal: Journal
    ) -> None:
        self._device = device
        self._robot_type = robot_type
        self._owner = owner
        self._keys = keys
        self._journal = journal

    def check(self, order: RunMovement) -> None:
        """Look at a script before anything of it is run.

        Raises:
            Refused: Changed, not signed, of another robot type, or older than one of its name that ran here.
        """
        if order.robot_type != self._robot_type:
            raise Refused("wrong_type", f"a movement of '{order.robot_type}', not of '{self._robot_type}'")
        if hashlib.sha256(order.source.encode()).hexdigest() != order.sha256:
            raise Refused("wrong_hash", "the script is not the one that was signed for; save the movement again")
        self._check_signature(order)
        highest = self._journal.movement(self._device, order.author, order.robot_type, order.name)
        if order.version < highest:
            raise Refused(
                "rolled_back",
                f"version {order.version} of '{order.name}' is older than version {highest}, which has run on this "
                "device; save the script again, which gives it a new version",
            )

    def remember(self, order: RunMovement) -> None:
        """A script begins: none of its name that is older may follow."""
        self._journal.save_movement(self._device, order.author, order.robot_type, order.name, order.version)

    def stranger(self, order: RunMovement) -> bool:
        """Whether its author is neither the account that the agent is paired with nor who made Telescope."""
        return order.author not in {SHIPPED, self._owner} or not order.author

    def _check_signature(self, order: RunMovement) -> None:
        key = self._keys.get(order.key)
        if key is None:
            raise Refused(
                "bad_signature", "the movement is not signed with a key that this device knows; save it again"
            )
        text = signing.movement_text(order.robot_type, order.name, order.version, order.sha256)
        try:
            signing.verify_text(text, order.signature, key, context=signing.MOVEMENT_CONTEXT)
        except SignatureError as error:
            raise Refused("bad_signature", "the movement is not the one that was signed; save it again") from error
