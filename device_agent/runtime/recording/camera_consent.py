"""Consent to record cameras: decisions of the owner, which the agent verifies, stores and enforces.

Without a stored decision of the present owner no camera may be recorded.
"""

import math
import threading
import time
from collections.abc import Collection, Mapping

import msgspec
from msgspec import Struct

from device_agent.ports.clock import wall_ms
from device_agent.protocol import CameraConsent, SetCameraConsent
from device_agent.runtime.errors import Refused
from device_agent.runtime.storage.journal import Journal


class _Stored(Struct, frozen=True, kw_only=True):
    """A consent in the journal, with the space and account that it belongs to."""

    space: str
    account: str
    consent: CameraConsent


class CameraConsents:
    """Consents of an agent's devices. Thread-safe.

    Args:
        journal: Stores them.
        space: Space of the agent. Consent ends if the agent moves to another room.
        account: Account id of its owner; empty: unknown, so no account can consent.
    """

    def __init__(self, journal: Journal, *, space: str, account: str) -> None:
        self._journal = journal
        self._space = space
        self._account = account
        self._lock = threading.Lock()
        self._consents: dict[str, CameraConsent] = {}
        self._since_s: dict[str, Mapping[str, float]] = {}

    def of(self, device: str) -> CameraConsent:
        """The present consent for a device.

        Raises:
            JournalError: It cannot be read.
        """
        with self._lock:
            if device not in self._consents:
                self._consents[device] = consent = self._load(device)
                self._since_s[device] = dict.fromkeys(consent.cameras, -math.inf)
            return self._consents[device]

    def _load(self, device: str) -> CameraConsent:
        number, content = self._journal.camera_consent(device)
        try:
            stored = msgspec.json.decode(content, type=_Stored)
        except msgspec.DecodeError:  # there is none, or a version that cannot be read: no consent
            return CameraConsent(number=number)
        if (stored.space, stored.account) != (self._space, self._account):
            return CameraConsent(number=number)
        return stored.consent

    def permits(self, device: str, camera: str, taken_s: float) -> bool:
        """Whether a frame may be recorded that this camera took at a time of the monotonic clock [s]."""
        self.of(device)
        return taken_s >= self._since_s[device].get(camera, math.inf)

    def decide(self, device: str, cameras: Collection[str], request: SetCameraConsent, *, caller: str) -> bool:
        """Apply a decision of the owner; returns whether it is new. A withdrawal is in force before it is stored.

        Args:
            device: Name of the device.
            cameras: Its cameras that can be recorded.
            request: The verified request.
            caller: Name of the account.

        Raises:
            Refused: The account is not the owner, the decision is older than the present one, or a camera is unknown;
                withdrawals of a decision with an unknown camera are in force nevertheless.
            JournalError: It cannot be stored. New consent is then not in force.
        """
        before = self.of(device)
        if not self._account or request.account != self._account:
            raise Refused("not_owner", "only the owner who paired this agent may decide what its cameras record")
        if request.number == before.number and set(request.cameras) == set(before.cameras):
            return False  # a repetition
        if request.number <= before.number:
            raise Refused(
                "outdated", f"decision {request.number} is older than decision {before.number} of this device"
            )
        kept = tuple(each for each in before.cameras if each in request.cameras)
        unknown = sorted(set(request.cameras) - set(cameras))
        if not unknown:
            self._apply(device, before, kept, self._consent(request, request.cameras, caller))
            return True
        # The cloud may know cameras that were removed meanwhile. What the owner has withdrawn is not recorded any more.
        if kept != before.cameras:
            self._apply(device, before, kept, self._consent(request, kept, caller))
        names = ", ".join(sorted(cameras)) or "none"
        raise Refused("unknown_camera", f"no camera '{unknown[0]}' can be recorded here; there are: {names}")

    @staticmethod
    def _consent(request: SetCameraConsent, cameras: tuple[str, ...], caller: str) -> CameraConsent:
        return CameraConsent(cameras=cameras, by=caller, at_ms=wall_ms(), number=request.number)

    def _apply(self, device: str, before: CameraConsent, kept: tuple[str, ...], consent: CameraConsent) -> None:
        """Withdraw all cameras except ``kept``, store the new consent, and put it into force."""
        self._set(device, before, kept)
        stored = _Stored(space=self._space, account=self._account, consent=consent)
        self._journal.save_camera_consent(device, consent.number, msgspec.json.encode(stored))
        self._set(device, consent, consent.cameras)

    def _set(self, device: str, consent: CameraConsent, cameras: Collection[str]) -> None:
        now_s = time.monotonic()
        with self._lock:
            since_s = self._since_s[device]
            self._consents[device] = msgspec.structs.replace(consent, cameras=tuple(cameras))
            self._since_s[device] = {camera: since_s.get(camera, now_s) for camera in cameras}
