"""Home Assistant discovery: one retained configuration for each value, control and camera. Pure functions.

Fields follow https://www.home-assistant.io/integrations/mqtt/. Measurements are forwarded unchanged, and a
``value_template`` selects the value.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from device_agent.protocol import CameraStream, Control, Description, camera_frames

DISCOVERY = "homeassistant"
"""Home Assistant's default discovery prefix."""
ROOT = "telescope"
_LEAST_STEP = 0.001
"""Home Assistant's minimum step."""
SETTINGS = "settings"
"""Stream with the current values of controls."""

_CLASSES: Mapping[str, tuple[str, str]] = {
    "temperature_c": ("temperature", "°C"),
    "humidity_percent": ("humidity", "%"),
    "co2_ppm": ("carbon_dioxide", "ppm"),
    "light_lux": ("illuminance", "lx"),
    "sound_db": ("sound_pressure", "dB"),
}
"""Quantity → Home Assistant's device class and unit."""
_UNITS: Mapping[str, tuple[str, str]] = {
    "_m": ("distance", "m"),
    "_c": ("temperature", "°C"),
    "_v": ("voltage", "V"),
    "_a": ("current", "A"),
}
"""Suffix of other quantities → device class and unit."""
_BINARY: Mapping[str, str] = {"present": "motion", "open": "opening"}


class Announcement(NamedTuple):
    """One configuration: a retained topic and its content."""

    topic: str
    content: dict[str, Any]


_FOR_PROGRAMS = "_bits"
"""Suffix of values for programs only: bit rows of the occupancy grid."""


def topic(device: str, kind: str, name: str = "") -> str:
    """Topic of the bridge for a device: ``telescope/{device}/{kind}[/{name}]``."""
    return f"{ROOT}/{device}/{kind}" + (f"/{name}" if name else "")


def announce_values(
    device: str, description: Description, stream: str, values: Mapping[str, float | bool]
) -> Iterator[Announcement]:
    """Configurations of the values of a stream, as one measurement contains them."""
    controls = {control.name for control in description.controls}
    for field, value in values.items():
        if stream == SETTINGS and field in controls:
            continue  # already a number entity
        quantity, _, part = field.partition(".")
        if quantity.endswith(_FOR_PROGRAMS):
            continue
        selector = f"value_json['values']['{field}']"
        content = _common(device, description, f"{stream}-{field}", _readable(quantity, part))
        content["state_topic"] = topic(device, "tele", stream)
        if isinstance(value, bool):
            content["value_template"] = "{{ 'ON' if " + selector + " else 'OFF' }}"
            if quantity in _BINARY:
                content["device_class"] = _BINARY[quantity]
            yield _announce("binary_sensor", device, f"{stream}-{field}", content)
            continue
        content |= {"value_template": "{{ " + selector + " }}", "state_class": "measurement"}
        unit = _CLASSES.get(quantity) or next((each for end, each in _UNITS.items() if quantity.endswith(end)), None)
        if unit is not None:
            content["device_class"], content["unit_of_measurement"] = unit
        yield _announce("sensor", device, f"{stream}-{field}", content)


def pictures(description: Description) -> tuple[CameraStream, ...]:
    """The streams of frames that Home Assistant can show."""
    return tuple(camera for camera in description.cameras if camera.kind == camera_frames.COLOUR)


def announce_device(device: str, description: Description) -> Iterator[Announcement]:
    """Configurations of a device's controls and cameras."""
    for control in description.controls:
        yield _announce("number", device, f"set-{control.name}", _number(device, description, control))
    for camera in pictures(description):
        content = _common(device, description, f"cam-{camera.name}", camera.name)
        content["topic"] = topic(device, "cam", camera.name)
        yield _announce("camera", device, f"cam-{camera.name}", content)


def _number(device: str, description: Description, control: Control) -> dict[str, Any]:
    content = _common(device, description, f"set-{control.name}", control.label) | {
        "command_topic": topic(device, "set", control.name),
        "min": control.lower,
        "max": control.upper,
        "step": max(_LEAST_STEP, round((control.upper - control.lower) / 100, 6)),
        "mode": "slider",
    }
    if control.unit:
        content["unit_of_measurement"] = control.unit
    if any(stream.name == SETTINGS for stream in description.streams):
        content["state_topic"] = topic(device, "tele", SETTINGS)
        content["value_template"] = "{{ value_json['values']['" + control.name + "'] }}"
    return content


def _common(device: str, description: Description, part: str, name: str) -> dict[str, Any]:
    return {
        "name": name,
        "unique_id": f"{ROOT}-{device}-{part}",
        "availability_topic": topic(device, "available"),
        "device": {
            "identifiers": [f"{ROOT}-{device}"],
            "name": description.label,
            "manufacturer": "Telescope",
            "model": description.kind,
        },
    }


def _readable(quantity: str, part: str) -> str:
    text = quantity.replace("_", " ")
    return f"{text} {part}" if part else text


def _announce(component: str, device: str, part: str, content: dict[str, Any]) -> Announcement:
    return Announcement(f"{DISCOVERY}/{component}/{device}/{part.replace('.', '_')}/config", content)
