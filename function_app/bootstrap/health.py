"""Factories of the health services."""

from functools import cached_property

from function_app.bootstrap.robot_types import RobotTypeServices
from function_app.services.health.diagnostics import Diagnostics
from function_app.services.health.faults import Faults
from function_app.services.health.reported_faults import ReportedFaults
from function_app.services.telemetry.ingest import TelemetryIngest


class HealthServices(RobotTypeServices):
    """Creates each health service on first use."""

    @cached_property
    def faults(self) -> Faults:
        return Faults(tables=self.tables, events=self.events, retention=self.retention, clock=self.clock)

    @cached_property
    def reported_faults(self) -> ReportedFaults:
        return ReportedFaults(tables=self.tables, faults=self.faults, clock=self.clock)

    @cached_property
    def diagnostics(self) -> Diagnostics:
        return Diagnostics(
            tables=self.tables,
            devices=self.devices,
            faults=self.faults,
            robot_types=self.robot_types,
            spaces=self.spaces,
            clock=self.clock,
        )

    @cached_property
    def telemetry_ingest(self) -> TelemetryIngest:
        return TelemetryIngest(
            tables=self.tables,
            writer=self.series_writer,
            clock=self.clock,
            observers=(self.diagnostics.observe,),
            refuse=self.quota.refuse_measurement,
        )
