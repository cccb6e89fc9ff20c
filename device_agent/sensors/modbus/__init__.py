"""Room driver for devices with Modbus, over TCP or a serial line (RTU)."""

from pathlib import Path

from device_agent.ports.sensor import RoomDriver, Surroundings
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.configured_device import parse_options
from device_agent.sensors.modbus.driver import ModbusDevice
from device_agent.sensors.modbus.options import Options

__all__ = ["create"]


def create(device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> RoomDriver:  # noqa: ARG001 (the port)
    """Entry point: create the driver of one device without opening it."""
    return ModbusDevice(device, parse_options(device, Options))
