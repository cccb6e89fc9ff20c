"""Records as the API shows them."""

from typing import Any

import msgspec

from device_agent.protocol import State
from device_agent.protocol.manifests.robot_type import RobotType
from function_app.domain.actions.action import Action
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.control.lease import ControlRequest, Lease
from function_app.domain.identity.accounts import Identity
from function_app.domain.robot_types.movements import Movement
from function_app.domain.robot_types.robot_types import TypeVersion
from function_app.entrypoints.http.accounts.schemas import AccountRef
from function_app.entrypoints.http.actions import schemas as actions
from function_app.entrypoints.http.control import schemas as leases
from function_app.entrypoints.http.devices import schemas as devices
from function_app.entrypoints.http.robot_types import schemas as robot_types
from function_app.entrypoints.http.robot_types import schemas_movements
from function_app.services.devices.device_access import DeviceView
from function_app.services.robot_types.catalogue import KnownType, Model
from function_app.services.robot_types.parameter_schema import ObjectSchema
from function_app.services.robot_types.preview import Preview
from function_app.services.robot_types.script_store import signed_text


def device(view: DeviceView, who: Identity, now_ms: int) -> devices.DeviceOut:
    """A device and what is known of it now."""
    known = view.device
    return devices.DeviceOut(
        id=known.id,
        name=known.name,
        label=known.label,
        kind=known.kind,
        robot_type=known.robot_type,
        agent=known.agent,
        space=known.space,
        role=known.role.value,
        owner=AccountRef(id=known.owner, name=view.owner_name),
        topic=known.topic,
        online=view.online,
        last_seen_at=None if view.last_seen_ms is None else rfc3339(view.last_seen_ms),
        state=None if view.state is None else msgspec.convert(view.state, State, strict=False),
        lease=lease(view.lease, who, now_ms),
    )


def lease(found: Lease | None, who: Identity, now_ms: int) -> leases.LeaseOut | None:
    """A live lease, with the open request for it."""
    if found is None:
        return None
    asked = None if found.request is None else control_request(found.request, found, who, now_ms)
    return leases.LeaseOut(
        holder=found.holder,
        epoch=found.epoch,
        expires_at=rfc3339(found.expires_ms),
        mine=found.held_by(who),
        reason=found.reason,
        request=asked if asked is not None and asked.outcome == "open" else None,
    )


def control_request(asked: ControlRequest, found: Lease, who: Identity, now_ms: int) -> leases.ControlRequestOut:
    """A request for control."""
    return leases.ControlRequestOut(
        id=asked.id,
        requester=asked.by,
        epoch=asked.epoch,
        mine=asked.requested_by(who),
        requested_at=rfc3339(asked.asked_ms),
        expires_at=rfc3339(asked.expires_ms),
        outcome=asked.current_outcome(found, now_ms),
    )


def action(found: Action, position: int | None = None) -> actions.ActionOut:
    """An action, and its place in the queue."""
    return actions.ActionOut(
        id=found.id,
        device=found.device,
        request=found.request,
        status=found.status.value,
        queue_position=position,
        epoch=found.epoch,
        caller=found.who,
        created_at=rfc3339(found.created_ms),
        deadline_at=rfc3339(found.deadline_ms),
        times={f"{status}_ms": at_ms for status, at_ms in found.times.items()},
        reason=None if found.reason is None else actions.ReasonOut(**found.reason),
        progress=found.progress,
        output=found.output,
        result=found.result,
    )


def robot_type(found: KnownType) -> robot_types.RobotTypeOut:
    """A robot type."""
    manifest, upload = found.manifest, found.upload
    return robot_types.RobotTypeOut(
        type=manifest.type,
        label=manifest.label,
        kind=manifest.kind,
        version=found.version,
        description=manifest.description,
        driver=manifest.driver,
        joints=manifest.joints,
        frames=manifest.frames,
        capabilities=manifest.capabilities,
        home_rad=manifest.home_rad,
        mimic_joints=manifest.mimic_joints,
        position_dependent_limits=manifest.position_dependent_limits,
        postures=tuple(manifest.postures),
        expressions=tuple(manifest.expressions),
        behaviours=tuple(manifest.behaviours),
        actions=_actions(manifest),
        streams=manifest.streams,
        built_in=found.built_in,
        state="ready" if found.usable or upload is None else _upload_state(upload),
        files=found.files,
        upload=None if upload is None else _upload(upload),
    )


def _actions(manifest: RobotType) -> tuple[str, ...]:
    """As far as the manifest tells: what a driver adds, and what a room's floor allows, only the robot knows."""
    has = {
        "move_joints": bool(manifest.joints),
        "say": "speech" in manifest.capabilities,
        "express": bool(manifest.expressions),
        "take_posture": bool(manifest.postures),
        "run_behaviour": bool(manifest.behaviours),
        "drive": manifest.base is not None,
        "go_to": manifest.base is not None,
    }
    return tuple(kind for kind, there in has.items() if there)


def twin(found: Model) -> robot_types.RobotTypeTwin:
    """The drawing of a robot type."""
    return robot_types.RobotTypeTwin(
        device=found.twin.device, bodies=found.twin.bodies, actuators=found.actuators, cameras=found.cameras
    )


def look(found: Preview) -> robot_types.RobotTypePreviewOut:
    """An upload that is looked at."""
    upload = found.upload
    known = KnownType(found.manifest, upload.version, upload.files, usable=upload.state == "ready", upload=upload)
    return robot_types.RobotTypePreviewOut(
        id=found.id, expires_at=rfc3339(found.expires_ms), robot_type=robot_type(known)
    )


def _upload(upload: TypeVersion) -> robot_types.RobotTypeUploadOut:
    return robot_types.RobotTypeUploadOut(
        version=upload.version,
        state=_upload_state(upload),
        errors=() if upload.open else upload.errors,
        warnings=upload.warnings,
        uploaded_at=rfc3339(upload.created_ms),
    )


def _upload_state(upload: TypeVersion) -> robot_types.State:
    return "checking" if upload.state == "uploading" else upload.state


def movement(found: Movement) -> schemas_movements.MovementOut:
    """A movement without its source."""
    return schemas_movements.MovementOut(**_movement(found))


def movement_source(robot_type: str, found: Movement, source: str, public: str) -> schemas_movements.MovementSource:
    """A movement with its source; ``public`` is the key that its signature names."""
    signature = schemas_movements.SignatureOut(
        key=found.key, public=public, signed=signed_text(robot_type, found), signature=found.signature
    )
    return schemas_movements.MovementSource(**_movement(found), source=source, signature=signature)


def _movement(found: Movement) -> dict[str, Any]:
    schema = found.parameters_schema
    return {
        "name": found.name,
        "description": found.description,
        "version": found.version,
        "sha256": found.sha256,
        "updated_at": rfc3339(found.updated_ms),
        "built_in": found.built_in,
        "parameters_schema": None if schema is None else msgspec.convert(schema, ObjectSchema),
    }
