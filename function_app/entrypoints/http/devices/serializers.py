"""Converts devices to API responses."""

from typing import Literal

import msgspec

from device_agent.protocol import State
from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.identity.accounts import Identity
from function_app.entrypoints.http.control.serializers import lease_out
from function_app.entrypoints.http.devices.schemas import DeviceOut
from function_app.entrypoints.http.framework.schemas import AccountRef, response_from
from function_app.services.devices.device_access import DeviceView


def device_out(functions: Functions, view: DeviceView, caller: Identity) -> DeviceOut:
    """The response for a device with its presence, newest state and lease."""
    device = view.device
    over: tuple[Literal["mqtt", "xmpp"], ...] = ("mqtt", "xmpp") if functions.settings.xmpp.websocket_url else ("mqtt",)
    return response_from(
        device,
        DeviceOut,
        role=device.role.value,
        owner=AccountRef(id=device.owner, name=view.owner_name),
        online=view.online,
        incompatible=view.incompatible or None,
        last_seen_at=None if view.last_seen_ms is None else rfc3339(view.last_seen_ms),
        state=None if view.state is None else msgspec.convert(view.state, State, strict=False),
        lease=lease_out(view.lease, caller, functions.clock.now_ms()),
        setpoints_over=over if device.streaming else (),
    )
