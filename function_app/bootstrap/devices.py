"""Factories of the devices services."""

from functools import cached_property

from function_app.bootstrap.identity import IdentityServices
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.devices.rename import DeviceRename
from function_app.services.devices.spaces import Spaces
from function_app.services.devices.viewers import Viewers


class DeviceServices(IdentityServices):
    """Creates each devices service on first use."""

    @cached_property
    def devices(self) -> DeviceAccess:
        return DeviceAccess(tables=self.tables, clock=self.clock)

    @cached_property
    def spaces(self) -> Spaces:
        return Spaces(tables=self.tables, clock=self.clock)

    @cached_property
    def rename(self) -> DeviceRename:
        return DeviceRename(tables=self.tables, devices=self.devices, audit_log=self.audit_log)

    @cached_property
    def viewers(self) -> Viewers:
        return Viewers(tables=self.tables, devices=self.devices, retention=self.retention, clock=self.clock)
