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


async def check(tables: Tables, device: Device, asked: Task) -> None:
    """Reject a task that the description excludes. Without a description the device decides.

    Raises:
        Problem: ``unable``; the text lists the available names.
    """
    if isinstance(asked, MoveJoints):
        return  # frequent and supported by nearly every device: skip reading the description
    row = await tables.get(records.DESCRIPTIONS, device.agent, device.name)
    if row is None:
        return
    described = records.read(row, Description)
    if not described.actions:
        return
    kind = str(type(asked).__struct_config__.tag)
    _among("kind of action", kind, described.actions)
    for word, name, reached in _named(asked, described):
        _among(word, name, reached)


def _named(asked: Task, described: Description) -> Iterable[tuple[str, str, Sequence[str]]]:
    """The names in a task: their kind, the name, and the available names."""
    match asked:
        case Express(name=name):
            yield "expression", name, described.expressions
        case MovePose(frame=frame) if frame:
            yield "frame", frame, described.frames
        case TakePosture(name=name):
            yield "posture", name, described.postures
        case RunBehaviour(name=name):
            yield "behaviour", name, described.behaviours
        case CollectData(streams=streams) | TakePicture(streams=streams):
            for stream in streams:
                yield "stream", stream, [each.name for each in described.streams]
        case CaptureRaw(name=name):
            yield "capture", name, described.captures
        case SetControl(control=control):
            yield "control", control, [each.name for each in described.controls]


def _among(word: str, name: str, reached: Sequence[str]) -> None:
    if name not in reached:
        detail = f"This device has no {word} '{name}'; it has: {', '.join(reached) or 'none'}."
        raise Problem("unable", 422, "The device cannot do this", detail, extras={"names": list(reached)})
