"""Checks a task against the device's description before the action occupies the slot."""

from collections.abc import Iterable, Sequence

from device_agent.protocol import (
    CaptureRaw,
    CollectData,
    Description,
    Express,
    MoveJoints,
    MovePose,
    RunBehaviour,
    SetControl,
    TakePicture,
    TakePosture,
    Task,
)
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Device
from function_app.ports.tables import Tables
from function_app.services.storage import records


async def check(tables: Tables, device: Device, task: Task) -> None:
    """Reject a task that the description excludes. Without a description the device decides.

    Raises:
        Problem: ``unable``; the text lists the available names.
    """
    if isinstance(task, MoveJoints):
        return  # frequent and supported by nearly every device: skip reading the description
    row = await tables.get(records.DESCRIPTIONS, device.agent, device.name)
    if row is None:
        return
    description = records.read(row, Description)
    if not description.actions:
        return
    kind = str(type(task).__struct_config__.tag)
    _require_available("kind of action", kind, description.actions)
    for category, name, available in _names(task, description):
        _require_available(category, name, available)


def _names(task: Task, description: Description) -> Iterable[tuple[str, str, Sequence[str]]]:
    """The names in a task: their kind, the name, and the available names."""
    match task:
        case Express(name=name):
            yield "expression", name, description.expressions
        case MovePose(frame=frame) if frame:
            yield "frame", frame, description.frames
        case TakePosture(name=name):
            yield "posture", name, description.postures
        case RunBehaviour(name=name):
            yield "behaviour", name, description.behaviours
        case CollectData(streams=streams) | TakePicture(streams=streams):
            for stream in streams:
                yield "stream", stream, [each.name for each in description.streams]
        case CaptureRaw(name=name):
            yield "capture", name, description.captures
        case SetControl(control=control):
            yield "control", control, [each.name for each in description.controls]


def _require_available(category: str, name: str, available: Sequence[str]) -> None:
    if name not in available:
        detail = f"This device has no {category} '{name}'; it has: {', '.join(available) or 'none'}."
        raise Problem("unable", 422, "The device cannot do this", detail, extras={"names": list(available)})
