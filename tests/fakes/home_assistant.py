"""Prints the MQTT discovery schema of Home Assistant as JSON. Requires the package ``homeassistant``."""

import json
import sys
from typing import Any

import voluptuous as vol
from homeassistant.components.binary_sensor import BinarySensorDeviceClass
from homeassistant.components.mqtt import binary_sensor, camera, number, sensor
from homeassistant.components.sensor.const import DEVICE_CLASS_UNITS, SensorDeviceClass
from homeassistant.const import __version__


def keys(schema: Any) -> dict[str, bool]:
    """The keys of a schema: name → whether it is required."""
    if isinstance(schema, vol.All):
        result: dict[str, bool] = {}
        for part in schema.validators:
            result |= keys(part)
        return result
    if isinstance(schema, vol.Schema) and isinstance(schema.schema, dict):
        return {str(key): isinstance(key, vol.Required) for key in schema.schema}
    return {}


if __name__ == "__main__":
    units = {
        str(kind.value): sorted(str(getattr(unit, "value", unit)) for unit in DEVICE_CLASS_UNITS.get(kind, ()) if unit)
        for kind in SensorDeviceClass
    }
    modules = {"sensor": sensor, "binary_sensor": binary_sensor, "number": number, "camera": camera}
    result = {
        "version": __version__,
        "keys": {name: keys(module.DISCOVERY_SCHEMA) for name, module in modules.items()},
        "sensor_units": units,
        "binary_sensor_classes": sorted(kind.value for kind in BinarySensorDeviceClass),
    }
    json.dump(result, sys.stdout, indent=1, ensure_ascii=False, sort_keys=True)
    sys.stdout.write("\n")
