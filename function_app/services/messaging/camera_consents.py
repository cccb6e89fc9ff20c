"""The owner's decisions which cameras of a device may be recorded, and their delivery.

A decision is stored with the next number, then sent. A device that reports an older number gets it again, so a
withdrawal reaches an agent that was offline as soon as it connects. The agent decides what it records.
"""

import logging
from dataclasses import dataclass
from typing import Final

from device_agent.protocol import Description, Reason, SetCameraConsent, State, camera_frames
from function_app.domain.audit.hash_chain import AccountEvent
from function_app.domain.common.problems import Problem, invalid
from function_app.domain.devices.camera_consent import CameraDecision
from function_app.domain.devices.devices import Agent, Device, LastState, Link
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.audit.audit_log import AuditLog
from function_app.services.devices.device_access import DeviceAccess, devices_of, require_owner
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.messaging.delivery import Confirmation
from function_app.services.storage import records

KEY: Final = "camera-consent"
"""Key of a device's decision in its partition of ``Control``."""
KIND: Final = str(SetCameraConsent.__struct_config__.tag)

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CameraConsentStatus:
    """The newest decision, and whether the device has stored it.

    ``decision``: ``None`` if there is none. ``reason``: why the device rejected it.
    """

    decision: CameraDecision | None
    confirmed: bool
    reason: Reason | None = None


class CameraConsents:
    """Stores and delivers decisions."""

    def __init__(
        self, *, tables: Tables, devices: DeviceAccess, command_sender: CommandSender, audit_log: AuditLog, clock: Clock
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._command_sender = command_sender
        self._audit_log = audit_log
        self._clock = clock

    async def get(self, caller: Identity, device_id: str) -> CameraConsentStatus:
        """The newest decision for a device. Raises ``device-unknown``."""
        device = await self._devices.get(caller, device_id)
        decision = await self._find(device)
        if decision is None:
            return CameraConsentStatus(None, confirmed=True)
        return CameraConsentStatus(decision, confirmed=await self._reported(device) >= decision.number)

    async def decide(
        self, caller: Identity, device_id: str, cameras: tuple[str, ...], *, wait_ms: int
    ) -> CameraConsentStatus:
        """Store a decision of the owner, and send it; wait at most ``wait_ms`` until the device has stored it.

        Raises:
            Problem: ``device-unknown``; ``forbidden``: the caller is not the owner; ``unable``: the agent cannot record
                cameras; ``invalid``: a camera is unknown; ``busy``.
        """
        device, link = await self._devices.get_with_link(caller, device_id)
        require_owner(device)
        cameras = tuple(dict.fromkeys(cameras))
        await self._check(device, link, cameras)
        reported = await self._reported(device)
        async with self._audit_log.change(
            caller.account, AccountEvent.CAMERA_CONSENT_SET, caller, on=device.id, cameras=list(cameras)
        ) as change:
            await change.store_pending()

            def changed(existing: CameraDecision | None) -> CameraDecision:
                # A device that knows a higher number has seen decisions from before a backup was restored.
                number = max(0 if existing is None else existing.number, reported) + 1
                return CameraDecision(
                    cameras=cameras,
                    account=caller.account,
                    by=caller.name,
                    at_ms=self._clock.now_ms(),
                    number=number,
                    pairing=device.pairing,
                    space=device.space,
                )

            decision = await records.upsert(self._tables, records.CONTROL, device.id, KEY, changed, CameraDecision)
        assert decision is not None  # noqa: S101 (``changed`` always returns one)
        try:
            confirmation = await self._command_sender.send_confirmed(
                device, _request(decision), caller=decision.by, epoch=0, wait_ms=wait_ms
            )
        except Problem as problem:
            _log.warning("decision %d about cameras of %s: %s", decision.number, device.id, problem.detail)
            confirmation = Confirmation()
        return CameraConsentStatus(decision, confirmation.confirmed, confirmation.reason)

    async def on_state(self, agent: Agent, name: str, state: State) -> None:
        """Send the newest decision again to a device that reports an older one. Called with each of its states."""
        if state.camera_consent is None:
            return
        device = next(each for each in devices_of(agent) if each.name == name)
        decision = await self._find(device)
        if decision is not None and state.camera_consent.number < decision.number:
            _log.info("decision %d about cameras of %s is delivered again", decision.number, device.id)
            await self._command_sender.try_send(device, _request(decision), caller=decision.by, epoch=0)

    async def _find(self, device: Device) -> CameraDecision | None:
        _, decision = await records.find(self._tables, records.CONTROL, device.id, KEY, CameraDecision)
        return decision if decision is not None and decision.applies_to(device) else None

    async def _reported(self, device: Device) -> int:
        """Number of the decision that the device has reported; 0 for none."""
        _, last = await records.find(self._tables, records.AGENTS, device.agent, f"state:{device.name}", LastState)
        consent = None if last is None else last.state.get("camera_consent")
        return int(consent["number"]) if consent else 0

    async def _check(self, device: Device, link: Link | None, cameras: tuple[str, ...]) -> None:
        if link is not None and link.capabilities and KIND not in link.capabilities:
            detail = "The agent of this device is too old to record cameras. Update the agent."
            raise Problem("unable", 422, "The device cannot do this", detail)
        _, description = await records.find(self._tables, records.DESCRIPTIONS, device.agent, device.name, Description)
        described = () if description is None else description.cameras
        known = [camera.name for camera in described if camera.kind == camera_frames.COLOUR]
        for camera in cameras:
            if camera not in known:
                raise invalid(
                    f"No camera '{camera}' of this device can be recorded; it has: {', '.join(known) or 'none'}."
                )


def _request(decision: CameraDecision) -> SetCameraConsent:
    return SetCameraConsent(cameras=decision.cameras, account=decision.account, number=decision.number)
