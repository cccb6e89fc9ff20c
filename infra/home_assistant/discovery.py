"""What Home Assistant is told of a device: one retained configuration for each value, control and camera. Pure.

Fields after https://www.home-assistant.io/integrations/mqtt/. Measurements pass as they are, and a ``value_template``
picks the value out, so a new field needs nothing new here.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from device_agent.protocol import Control, Description

DISCOVERY = "homeassistant"
"""Where Home Assistant looks, unless it was told otherwise."""
ROOT = "telescope"
_LEAST_STEP = 0.001
"""Home Assistant takes no finer one."""
SETTINGS = "settings"
"""The stream that carries what controls are at."""

_CLASSES: Mapping[str, tuple[str, str]] = {
    "temperature_c": ("temperature", "°C"),
    "humidity_percent": ("humidity", "%"),
    "co2_ppm": ("carbon_dioxide", "ppm"),
    "light_lux": ("illuminance", "lx"),
    "sound_db": ("sound_pressure", "dB"),
}
"""Quantity → Home Assistant's class and unit."""
_UNITS: Mapping[str, tuple[str, str]] = {
    "_m": ("distance", "m"),
    "_c": ("temperature", "°C"),
    "_v": ("voltage", "V"),
    "_a": ("current", "A"),
}
"""How other quantities end → class and unit."""
_BINARY: Mapping[str, str] = {"present": "motion", "open": "opening"}


class Announcement(NamedTuple):
    """One configuration: a retained topic and its content."""

    topic: str
    content: dict[str, Any]


_FOR_PROGRAMS = "_bits"
"""So end names of values that say nothing to people: rows of the room's floor, a place a bit."""


def topic(device: str, kind: str, name: str = "") -> str:
    """Where the bridge says what a device says: ``telescope/{device}/{kind}[/{name}]``."""
    return f"{ROOT}/{device}/{kind}" + (f"/{name}" if name else "")


def of_values(
    device: str, about: Description, stream: str, values: Mapping[str, float | bool]
) -> Iterator[Announcement]:
    """What a stream measures, known once it has been measured.

    Args:
        device: Its id.
        about: What it says of itself.
        stream: The stream's name.
        values: Of one measurement.
    """
    controls = {control.name for control in about.controls}
    for field, value in values.items():
        if stream == SETTINGS and field in controls:
            continue  # its number shows it
        quantity, _, part = field.partition(".")
        if quantity.endswith(_FOR_PROGRAMS):
            continue
        picked = f"value_json['values']['{field}']"
        content = _common(device, about, f"{stream}-{field}", _spoken(quantity, part)) | {
            "state_topic": topic(device, "tele", stream)
        }
        if isinstance(value, bool):
            content["value_template"] = "{{ 'ON' if " + picked + " else 'OFF' }}"
            if quantity in _BINARY:
                content["device_class"] = _BINARY[quantity]
            yield _announce("binary_sensor", device, f"{stream}-{field}", content)
            continue
        content |= {"value_template": "{{ " + picked + " }}", "state_class": "measurement"}
        known = _CLASSES.get(quantity) or next((each for end, each in _UNITS.items() if quantity.endswith(end)), None)
        if known is not None:
            content["device_class"], content["unit_of_measurement"] = known
        yield _announce("sensor", device, f"{stream}-{field}", content)


def of_device(device: str, about: Description) -> Iterator[Announcement]:
    """What a device has before it has measured anything: its controls and cameras."""
    for control in about.controls:
        yield _announce("number", device, f"set-{control.name}", _number(device, about, control))
    for camera in about.cameras:
        content = _common(device, about, f"cam-{camera.name}", camera.name) | {
            "topic": topic(device, "cam", camera.name)
        }
        yield _announce("camera", device, f"cam-{camera.name}", content)


def _number(device: str, about: Description, control: Control) -> dict[str, Any]:
    content = _common(device, about, f"set-{control.name}", control.label) | {
        "command_topic": topic(device, "set", control.name),
        "min": control.lower,
        "max": control.upper,
        "step": max(_LEAST_STEP, round((control.upper - control.lower) / 100, 6)),
        "mode": "slider",
    }
    if control.unit:
        content["unit_of_measurement"] = control.unit
    if any(stream.name == SETTINGS for stream in about.streams):
        content["state_topic"] = topic(device, "tele", SETTINGS)
        content["value_template"] = "{{ value_json['values']['" + control.name + "'] }}"
    return content


def _common(device: str, about: Description, part: str, name: str) -> dict[str, Any]:
    return {
        "name": name,
        "unique_id": f"{ROOT}-{device}-{part}",
        "availability_topic": topic(device, "available"),
        "device": {
            "identifiers": [f"{ROOT}-{device}"],
            "name": about.label,
            "manufacturer": "Telescope",
            "model": about.kind,
        },
    }


def _spoken(quantity: str, part: str) -> str:
    words = quantity.replace("_", " ")
    return f"{words} {part}" if part else words


def _announce(component: str, device: str, part: str, content: dict[str, Any]) -> Announcement:
    return Announcement(f"{DISCOVERY}/{component}/{device}/{part.replace('.', '_')}/config", content)
