"""Converts robot types, previews and movements to API responses."""

from typing import Any

import msgspec

from device_agent.protocol.manifests.task_kinds import kinds_of
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.robot_types.movements import Movement
from function_app.domain.robot_types.robot_types import TypeVersion
from function_app.entrypoints.http.framework.schemas import R, response_from
from function_app.entrypoints.http.robot_types import schemas
from function_app.services.robot_types.catalogue import KnownType, Model
from function_app.services.robot_types.parameter_schema import ObjectSchema
from function_app.services.robot_types.preview import Preview
from function_app.services.robot_types.script_store import signed_text


def robot_type_out(robot_type: KnownType) -> schemas.RobotTypeOut:
    """The response for a robot type in its active version, with its newest upload."""
    manifest, upload = robot_type.manifest, robot_type.upload
    return response_from(
        manifest,
        schemas.RobotTypeOut,
        version=robot_type.version,
        postures=tuple(manifest.postures),
        expressions=tuple(manifest.expressions),
        behaviours=tuple(manifest.behaviours),
        actions=kinds_of(manifest),
        built_in=robot_type.built_in,
        state="ready" if robot_type.usable or upload is None else _upload_state(upload),
        files=robot_type.files,
        upload=None if upload is None else _upload(upload),
    )


def twin_out(model: Model) -> schemas.RobotTypeTwin:
    """The response for the geometry of a robot type."""
    return response_from(model, schemas.RobotTypeTwin, device=model.twin.device, bodies=model.twin.bodies)


def preview_out(preview: Preview) -> schemas.RobotTypePreviewOut:
    """The response for a preview."""
    upload = preview.upload
    robot_type = KnownType(
        preview.manifest, upload.version, upload.files, usable=upload.state == "ready", upload=upload
    )
    return schemas.RobotTypePreviewOut(
        id=preview.id, expires_at=rfc3339(preview.expires_ms), robot_type=robot_type_out(robot_type)
    )


def _upload(upload: TypeVersion) -> schemas.RobotTypeUploadOut:
    return schemas.RobotTypeUploadOut(
        version=upload.version,
        state=_upload_state(upload),
        errors=() if upload.open else upload.errors,
        warnings=upload.warnings,
        uploaded_at=rfc3339(upload.created_ms),
    )


def _upload_state(upload: TypeVersion) -> schemas.State:
    return "checking" if upload.state == "uploading" else upload.state


def movement_out(movement: Movement) -> schemas.MovementOut:
    """The response for a movement without its source."""
    return _movement(movement, schemas.MovementOut)


def movement_source_out(robot_type: str, movement: Movement, source: str, public: str) -> schemas.MovementSource:
    """The response for a movement with its source. ``public``: the public key that verifies the signature."""
    signature = schemas.SignatureOut(
        key=movement.key, public=public, signed=signed_text(robot_type, movement), signature=movement.signature
    )
    return _movement(movement, schemas.MovementSource, source=source, signature=signature)


def _movement(movement: Movement, kind: type[R], **more: Any) -> R:
    schema = movement.parameters_schema
    return response_from(
        movement,
        kind,
        updated_at=rfc3339(movement.updated_ms),
        parameters_schema=None if schema is None else msgspec.convert(schema, ObjectSchema),
        **more,
    )
