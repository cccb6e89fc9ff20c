"""Signed commands on their way to a device, and the device's first answer."""

from msgspec.structs import replace

from device_agent.protocol import CancelAction, Command, Request, RunMovement, StopDevice, codec
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.security import signing
from function_app.domain.common.ids import command_id
from function_app.domain.common.problems import broker_unavailable, invalid
from function_app.domain.devices.devices import Device
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.signing_keys import SigningKeys
from function_app.services.messaging.delivery import Delivery, SignedCommand

SHORT_TTL_MS = 5_000
"""Time to live of lease and stop commands: what arrives later is no longer meant."""
STOP_KEPT_MS = 60_000
"""How long an agent that polls can still fetch a Stop: a late Stop is still a Stop."""
_ENVELOPE_BYTES = 512
"""More than signature, key, epoch and times add to a command that is checked before it has them."""


class CommandSender:
    """Builds, signs and sends."""

    def __init__(self, *, delivery: Delivery, keys: SigningKeys, clock: Clock) -> None:
        self._delivery = delivery
        self._keys = keys
        self._clock = clock

    def validate(self, device: Device, command: str, request: Request, *, caller: str, ttl_ms: int) -> None:
        """Refuse what a device would drop unread, before anything is written about it.

        Raises:
            Problem: ``invalid``: a field is out of its range, a number is not finite, or it is too long for a message.
        """
        order = _order(device, command, request, caller=caller, epoch=0, issued_ms=0, ttl_ms=ttl_ms)
        try:
            codec.decode(codec.encode(order, limit=codec.MAX_BYTES - _ENVELOPE_BYTES), Command)
        except ProtocolError as error:
            raise invalid(f"{error}.") from error

    async def sign(
        self, device: Device, command: str, request: Request, *, caller: str, epoch: int, issued_ms: int, ttl_ms: int
    ) -> SignedCommand:
        """One command, ready to be sent. The same arguments make the same bytes: the device drops the double.

        Raises:
            Problem: ``invalid``: it holds a number that is not finite, or is too long for a message.
        """
        if isinstance(request, RunMovement):
            request = await self._known_to_devices(request)
        order = _order(device, command, request, caller=caller, epoch=epoch, issued_ms=issued_ms, ttl_ms=ttl_ms)
        try:
            payload = signing.sign(codec.encode(order), await self._keys.for_devices())
        except ProtocolError as error:
            raise invalid(f"{error}.") from error
        stop = isinstance(request, StopDevice)
        return SignedCommand(command, payload, issued_ms + (STOP_KEPT_MS if stop else ttl_ms), first=stop)

    async def publish(self, device: Device, signed: SignedCommand) -> None:
        """Send a signed command.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        await self._delivery.send(device, signed)

    async def send(self, device: Device, request: Request, *, caller: str, epoch: int) -> str:
        """Sign and send a short-lived command; gives its id. A cancel takes back an action nobody has fetched.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        if isinstance(request, CancelAction):
            await self._delivery.withdraw(device, request.action)
        signed = await self._short(device, request, caller=caller, epoch=epoch)
        await self._delivery.send(device, signed)
        return signed.command

    async def send_confirmed(self, device: Device, request: Request, *, caller: str, epoch: int, wait_ms: int) -> bool:
        """Sign and send a short-lived command; whether the device accepted it within ``wait_ms``.

        Raises:
            Problem: ``broker-unavailable``.
        """
        signed = await self._short(device, request, caller=caller, epoch=epoch)
        try:
            return await self._delivery.send_confirmed(device, signed, wait_ms=wait_ms)
        except BusUnavailable as error:
            raise broker_unavailable(f"{error}.") from error

    async def _known_to_devices(self, order: RunMovement) -> RunMovement:
        """The same movement, signed with the key that devices know, once the one it was saved with is seen to be ours.

        A device knows the newest keys alone. What it is sent was saved with whichever was new then.
        """
        key = await self._keys.for_devices()
        name = signing.key_id(key.public_key())
        saved = (await self._keys.archive()).get(order.key)
        if order.key == name or saved is None:
            return order  # where it is not ours, the device is to refuse it
        text = signing.movement_text(order.robot_type, order.name, order.version, order.sha256)
        try:
            signing.verify_text(text, order.signature, saved, context=signing.MOVEMENT_CONTEXT)
        except SignatureError:
            return order
        signature = signing.sign_text(text, key, context=signing.MOVEMENT_CONTEXT)
        return replace(order, key=name, signature=signature)

    async def _short(self, device: Device, request: Request, *, caller: str, epoch: int) -> SignedCommand:
        now_ms = self._clock.now_ms()
        command = command_id(device.id, now_ms)
        return await self.sign(
            device, command, request, caller=caller, epoch=epoch, issued_ms=now_ms, ttl_ms=SHORT_TTL_MS
        )


def _order(
    device: Device, command: str, request: Request, *, caller: str, epoch: int, issued_ms: int, ttl_ms: int
) -> Command:
    return Command(
        id=command,
        space=device.space,
        agent=device.agent,
        device=device.name,
        issued_at_ms=issued_ms,
        ttl_ms=ttl_ms,
        caller=caller,
        epoch=epoch,
        request=request,
    )
