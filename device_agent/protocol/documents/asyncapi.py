"""Generates the AsyncAPI 3 document of the wire contract.

``python -m device_agent.protocol.documents.asyncapi`` prints it; ``make contract`` updates ``docs/asyncapi.json``.
"""

import inspect
import json
import sys
from typing import Any, NamedTuple

from device_agent import protocol
from device_agent.protocol import camera_frames, codec, topics


class _Channel(NamedTuple):
    name: str
    address: str
    message: str
    qos: int
    retain: bool
    summary: str
    to_agent: bool = False


_DEVICE = f"{topics.ROOT}/{{space}}/{{agent}}/{{device}}"
_CHANNELS = (
    _Channel(
        "presence", f"{topics.ROOT}/{{space}}/{{agent}}/conn", "Presence", 1, True, "Online or offline; also the will."
    ),
    _Channel("description", f"{_DEVICE}/desc", "Description", 1, True, "What the device is and can do."),
    _Channel("twin", f"{_DEVICE}/desc/twin", "Twin", 1, True, "Model for live views."),
    _Channel(
        "state", f"{_DEVICE}/state", "State", 1, True, "Current condition: on change and every 30 s, at most 1 Hz."
    ),
    _Channel(
        "joints",
        f"{_DEVICE}/tele/joints",
        "JointTelemetry",
        0,
        False,
        "All joints: 20 Hz at rest, 50 Hz in motion, and at each setpoint while streaming.",
    ),
    _Channel(
        "measurements",
        f"{_DEVICE}/tele/{{stream}}",
        "Measurements",
        0,
        False,
        "Named values measured at one moment; all streams except `joints`.",
    ),
    _Channel(
        "late_joints",
        f"{_DEVICE}/late/joints",
        "JointTelemetry",
        1,
        False,
        "Joints measured while the link was down, thinned, with their own times. Not live.",
    ),
    _Channel(
        "late_measurements",
        f"{_DEVICE}/late/{{stream}}",
        "Measurements",
        1,
        False,
        "As `late_joints`; all streams except `joints`.",
    ),
    _Channel("camera", f"{_DEVICE}/cam/{{camera}}", "CameraFrame", 0, False, "A frame: header, then content."),
    _Channel("event", f"{_DEVICE}/event", "Event", 1, False, "A fact that happened; stored."),
    _Channel("ack", f"{_DEVICE}/ack", "Ack", 1, False, "The response to one command."),
    _Channel("command", f"{_DEVICE}/cmd", "Signed", 1, False, "A signed request; `body` is a Command.", to_agent=True),
    _Channel(
        "stored",
        f"{_DEVICE}/stored",
        "Stored",
        0,
        False,
        "Acks, events and late measurements that are stored or rejected. The agent repeats them until then.",
        to_agent=True,
    ),
    _Channel(
        "setpoint",
        f"{_DEVICE}/ctl/{{epoch}}",
        "Tagged",
        0,
        False,
        "An authenticated setpoint; `body` is a Setpoint. The newest wins.",
        to_agent=True,
    ),
    _Channel(
        "stop",
        f"{_DEVICE}/stop/{{author}}",
        "Stop",
        1,
        False,
        "Latch Stop now; repeat until `state` shows the latch.",
        to_agent=True,
    ),
)
_PARAMETERS = {
    "space": "Id of the space.",
    "agent": "Id of the agent; also its MQTT client id.",
    "device": "The device's name at its agent.",
    "camera": "Name of the stream of frames.",
    "stream": "Name of the stream, except `joints`.",
    "epoch": "Epoch of the lease under which the setpoints are sent.",
    "author": "Id of the account that stops the device.",
}


def document() -> dict[str, Any]:
    """The wire contract as AsyncAPI 3.0, from the agent's view: it sends device messages and receives commands."""
    references, schemas = protocol.schema_components()
    references["Signed"] = {"$ref": "#/components/schemas/Signed"}
    schemas["Signed"] = {
        "title": "Signed",
        "description": "Ed25519 over `telescope/v1/command` + line feed + the exact bytes of `body`.",
        "type": "object",
        "properties": {
            "key": {"type": "string", "description": "Id of the signing key."},
            "signature": {"type": "string", "description": "base64url, without padding."},
            "body": references["Command"],
        },
        "required": ["key", "signature", "body"],
        "additionalProperties": False,
    }
    references["Tagged"] = {"$ref": "#/components/schemas/Tagged"}
    schemas["Tagged"] = {
        "title": "Tagged",
        "description": (
            "HMAC-SHA256 with the lease's `setpoint_key` over `telescope/v1/setpoint` + line feed + the topic + line "
            "feed + the exact bytes of `body`; the first 16 bytes."
        ),
        "type": "object",
        "properties": {
            "tag": {"type": "string", "pattern": "^[0-9a-f]{32}$", "description": "The tag in hexadecimal."},
            "body": references["Setpoint"],
        },
        "required": ["tag", "body"],
        "additionalProperties": False,
    }
    frame_format = inspect.cleandoc(camera_frames.__doc__ or "")
    references["CameraFrame"] = {"type": "string", "format": "binary", "description": frame_format}
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "Telescope, wire contract",
            "version": "1.0.0",
            "description": (
                "MQTT topics and messages between robots, their operators and the cloud. JSON, finite numbers only, at "
                f"most {codec.MAX_BYTES // 1024} KB per message and {codec.MAX_RETAINED_BYTES // 1024} KB if "
                f"retained. Ids match `{topics.ID_PATTERN}`."
            ),
        },
        "defaultContentType": "application/json",
        "channels": {channel.name: _channel(channel) for channel in _CHANNELS},
        "operations": {channel.name: _operation(channel) for channel in _CHANNELS},
        "components": {
            "schemas": schemas,
            "messages": {
                channel.message: {
                    "name": channel.message,
                    "payload": references[channel.message],
                    **({"contentType": "application/octet-stream"} if channel.message == "CameraFrame" else {}),
                }
                for channel in _CHANNELS
            },
        },
    }


def _channel(channel: _Channel) -> dict[str, Any]:
    return {
        "address": channel.address,
        "description": channel.summary,
        "messages": {channel.message: {"$ref": f"#/components/messages/{channel.message}"}},
        "parameters": {
            name: {"description": text} for name, text in _PARAMETERS.items() if f"{{{name}}}" in channel.address
        },
    }


def _operation(channel: _Channel) -> dict[str, Any]:
    return {
        "action": "receive" if channel.to_agent else "send",
        "summary": channel.summary,
        "channel": {"$ref": f"#/channels/{channel.name}"},
        "messages": [{"$ref": f"#/channels/{channel.name}/messages/{channel.message}"}],
        "bindings": {"mqtt": {"qos": channel.qos, "retain": channel.retain}},
    }


if __name__ == "__main__":
    json.dump(document(), sys.stdout, indent=1, ensure_ascii=False)
    sys.stdout.write("\n")
