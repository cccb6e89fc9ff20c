"""Builds, signs and sends commands to devices."""

import logging

from msgspec import UNSET
from msgspec.structs import replace

from device_agent.protocol import CancelAction, Command, Request, RunMovement, RunTrial, StopDevice, codec
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.fields import printable
from device_agent.protocol.security import signing
from function_app.domain.actions.action import Action
from function_app.domain.common.ids import command_id
from function_app.domain.common.problems import broker_unavailable, invalid
from function_app.domain.devices.devices import Device
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.monitoring import Counter, Metrics, Tracing
from function_app.ports.signing_keys import SigningKeys
from function_app.services.messaging.delivery import Confirmation, Delivery, SignedCommand

SHORT_TTL_MS = 5_000
"""Time to live of lease and Stop commands. A later arrival must have no effect."""
STOP_LIFETIME_MS = 60_000
"""A polling agent can fetch a Stop for this long: a late Stop is still valid."""
_ENVELOPE_BYTES = 512
"""Upper bound of what signature, key, epoch and times add to a validated command."""

_log = logging.getLogger(__name__)


class CommandSender:
    """Builds, signs and sends commands."""

    def __init__(
        self, *, delivery: Delivery, keys: SigningKeys, metrics: Metrics, tracing: Tracing, clock: Clock
    ) -> None:
        self._delivery = delivery
        self._keys = keys
        self._metrics = metrics
        self._tracing = tracing
        self._clock = clock

    def validated(self, device: Device, id_: str, request: Request, *, caller: str, traceparent: str) -> Command:
        """A command without epoch and times, which the device can decode.

        Raises:
            Problem: ``invalid``: a field is out of range, a number is not finite, or the message is too long.
        """
        command = _command(device, id_, request, caller=caller, ttl_ms=1, traceparent=traceparent)
        try:
            codec.decode(codec.encode(command, limit=codec.MAX_BYTES - _ENVELOPE_BYTES), Command)
        except ProtocolError as error:
            raise invalid(f"{error}.") from error
        return command

    async def sign(self, command: Command) -> SignedCommand:
        """Sign a command. Equal commands produce equal bytes, so the device drops duplicates.

        Raises:
            Problem: ``invalid``: a number is not finite, or the message is too long.
        """
        if isinstance(command.request, RunMovement):
            command = replace(command, request=await self._signed_for_devices(command.request))
        elif isinstance(command.request, RunTrial):
            movement = await self._signed_for_devices(command.request.movement)
            command = replace(command, request=replace(command.request, movement=movement))
        try:
            payload = signing.sign(codec.encode(command), await self._keys.for_devices())
        except ProtocolError as error:
            raise invalid(f"{error}.") from error
        self._metrics.count(Counter.COMMANDS, str(command.request.__struct_config__.tag))
        stop = isinstance(command.request, StopDevice)
        expires_ms = command.issued_at_ms + (STOP_LIFETIME_MS if stop else command.ttl_ms)
        return SignedCommand(command.id, payload, expires_ms, first=stop)

    async def send_action(self, device: Device, request: Request, action: Action, *, until_ms: int = 0) -> None:
        """Sign and publish the command of a stored action.

        Args:
            device: The device.
            request: What to run.
            action: The action.
            until_ms: A polling agent can fetch the command until then [ms since 1970]; 0: until it expires.

        Raises:
            BusUnavailable: The broker did not confirm the command.
        """
        command = _command(
            device,
            action.id,
            request,
            caller=action.caller,
            epoch=action.epoch,
            issued_ms=action.issued_ms,
            ttl_ms=action.ttl_ms,
            traceparent=action.traceparent,
        )
        signed = await self.sign(command)
        await self._delivery.send(device, signed._replace(expires_ms=until_ms or signed.expires_ms))

    async def send(self, device: Device, request: Request, *, caller: str, epoch: int) -> str:
        """Sign and send a short-lived command; return its id. A cancel also withdraws an action not yet fetched.

        Raises:
            BusUnavailable: The broker did not confirm the command.
        """
        if isinstance(request, CancelAction):
            await self._delivery.withdraw(device, request.action)
        signed = await self._sign_short_lived(device, request, caller=caller, epoch=epoch)
        await self._delivery.send(device, signed)
        return signed.command

    async def try_send(self, device: Device, request: Request, *, caller: str, epoch: int) -> bool:
        """As ``send``, best effort; return whether the broker confirmed the command."""
        try:
            await self.send(device, request, caller=caller, epoch=epoch)
        except BusUnavailable as error:
            _log.warning("%s for %s: %s", type(request).__name__, device.id, error)
            return False
        return True

    async def send_confirmed(
        self, device: Device, request: Request, *, caller: str, epoch: int, wait_ms: int, command: str = ""
    ) -> Confirmation:
        """Sign and send a short-lived command; return whether the device accepted it within ``wait_ms``.

        ``command``: its id; empty: a new one.

        Raises:
            Problem: ``broker-unavailable``.
        """
        signed = await self._sign_short_lived(device, request, caller=caller, epoch=epoch, command=command)
        try:
            return await self._delivery.send_confirmed(device, signed, wait_ms=wait_ms)
        except BusUnavailable as error:
            raise broker_unavailable(f"{error}.") from error

    async def _signed_for_devices(self, order: RunMovement) -> RunMovement:
        """The movement, signed with the key that devices know.

        Devices know only the newest keys. A movement may carry the signature of an older key. That signature is
        verified before the movement is signed again.
        """
        key = await self._keys.for_devices()
        name = signing.key_id(key.public_key())
        saved = (await self._keys.archive()).get(order.key)
        if order.key == name or saved is None:
            return order  # an unknown key: the device rejects the movement
        text = signing.movement_text(order.robot_type, order.name, order.version, order.sha256)
        try:
            signing.verify_text(text, order.signature, saved, context=signing.MOVEMENT_CONTEXT)
        except SignatureError:
            return order
        signature = signing.sign_text(text, key, context=signing.MOVEMENT_CONTEXT)
        return replace(order, key=name, signature=signature)

    async def _sign_short_lived(
        self, device: Device, request: Request, *, caller: str, epoch: int, command: str = ""
    ) -> SignedCommand:
        now_ms = self._clock.now_ms()
        id_ = command or command_id(device.id, now_ms)
        return await self.sign(
            _command(
                device,
                id_,
                request,
                caller=caller,
                epoch=epoch,
                issued_ms=now_ms,
                ttl_ms=SHORT_TTL_MS,
                traceparent=self._tracing.current(),
            )
        )


def _command(
    device: Device,
    id_: str,
    request: Request,
    *,
    caller: str,
    ttl_ms: int,
    traceparent: str,
    epoch: int = 0,
    issued_ms: int = 0,
) -> Command:
    return Command(
        id=id_,
        space=device.space,
        agent=device.agent,
        device=device.name,
        issued_at_ms=issued_ms,
        ttl_ms=ttl_ms,
        caller=printable(caller),
        epoch=epoch,
        request=request,
        traceparent=traceparent or UNSET,
    )
