"""Factories of the robot types services."""

from functools import cached_property

from function_app.bootstrap.telemetry import TelemetryServices
from function_app.services.robot_types.catalogue import RobotTypes
from function_app.services.robot_types.delete import RobotTypeDeletion
from function_app.services.robot_types.integrity import IntegritySeals
from function_app.services.robot_types.model_validation import ModelValidator
from function_app.services.robot_types.movements import Movements
from function_app.services.robot_types.preview import RobotTypePreview
from function_app.services.robot_types.upload import RobotTypeUpload
from function_app.services.robot_types.versions import TypeVersions


class RobotTypeServices(TelemetryServices):
    """Creates each robot types service on first use."""

    @cached_property
    def robot_types(self) -> RobotTypes:
        return RobotTypes(
            tables=self.tables, blobs=self.blobs, catalogue=self.catalogue, integrity=IntegritySeals(keys=self.keys)
        )

    @cached_property
    def type_versions(self) -> TypeVersions:
        return TypeVersions(tables=self.tables, blobs=self.blobs, quota=self.quota, clock=self.clock)

    @cached_property
    def upload_robot_type(self) -> RobotTypeUpload:
        return RobotTypeUpload(
            tables=self.tables,
            versions=self.type_versions,
            catalogue=self.catalogue,
            robot_types=self.robot_types,
            integrity=IntegritySeals(keys=self.keys),
            audit_log=self.audit_log,
            clock=self.clock,
        )

    @cached_property
    def movements(self) -> Movements:
        return Movements(
            tables=self.tables,
            blobs=self.blobs,
            quota=self.quota,
            catalogue=self.catalogue,
            robot_types=self.robot_types,
            keys=self.keys,
            retention=self.retention,
            audit_log=self.audit_log,
            clock=self.clock,
        )

    @cached_property
    def robot_type_preview(self) -> RobotTypePreview:
        return RobotTypePreview(
            tables=self.tables,
            blobs=self.blobs,
            versions=self.type_versions,
            catalogue=self.catalogue,
            robot_types=self.robot_types,
            upload=self.upload_robot_type,
            integrity=IntegritySeals(keys=self.keys),
            clock=self.clock,
        )

    @cached_property
    def delete_robot_type(self) -> RobotTypeDeletion:
        return RobotTypeDeletion(
            tables=self.tables,
            catalogue=self.catalogue,
            devices=self.devices,
            movements=self.movements,
            audit_log=self.audit_log,
            clock=self.clock,
        )

    @cached_property
    def model_checks(self) -> ModelValidator:
        from function_app.adapters.model_compiler.compiler import MujocoCompiler  # noqa: PLC0415 (rarely in use)

        compiler = MujocoCompiler(allow_unconfined=self.settings.allow_unconfined_models)
        return ModelValidator(tables=self.tables, blobs=self.blobs, compiler=compiler, clock=self.clock)
