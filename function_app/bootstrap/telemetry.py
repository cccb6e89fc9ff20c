"""Factories of the telemetry services."""

from functools import cached_property

from function_app.bootstrap.devices import DeviceServices
from function_app.domain.telemetry.series import RetentionPolicy
from function_app.services.storage.retention import DAY_MS
from function_app.services.telemetry.event_log import EventLog
from function_app.services.telemetry.latency import LatencyStore
from function_app.services.telemetry.recordings import Recordings
from function_app.services.telemetry.series_reader import SeriesReader
from function_app.services.telemetry.series_writer import SeriesWriter
from function_app.services.telemetry.session_log import SessionLog
from function_app.services.telemetry.uploads import Uploads


class TelemetryServices(DeviceServices):
    """Creates each telemetry service on first use."""

    @cached_property
    def events(self) -> EventLog:
        return EventLog(tables=self.tables, retention=self.retention, clock=self.clock)

    @cached_property
    def sessions_of_devices(self) -> SessionLog:
        return SessionLog(tables=self.tables, retention=self.retention, clock=self.clock)

    @cached_property
    def retention_policy(self) -> RetentionPolicy:
        settings = self.settings
        return RetentionPolicy(
            raw_ms=settings.retention.raw_hours * DAY_MS // 24,
            levels_ms={
                "10s": settings.retention.level_10s_days * DAY_MS,
                "1min": settings.retention.level_1min_days * DAY_MS,
                "10min": settings.retention.level_10min_days * DAY_MS,
            },
        )

    @cached_property
    def series_writer(self) -> SeriesWriter:
        return SeriesWriter(tables=self.tables, retention=self.retention, keep=self.retention_policy, clock=self.clock)

    @cached_property
    def uploads(self) -> Uploads:
        return Uploads(
            tables=self.tables,
            blobs=self.blobs,
            quota=self.quota,
            keep_ms=self.settings.retention.uploads_days * DAY_MS,
            clock=self.clock,
        )

    @cached_property
    def recordings(self) -> Recordings:
        return Recordings(
            tables=self.tables,
            blobs=self.blobs,
            session_log=self.sessions_of_devices,
            quota=self.quota,
            retention=self.retention,
            clock=self.clock,
        )

    @cached_property
    def latencies(self) -> LatencyStore:
        return LatencyStore(tables=self.tables, retention=self.retention, clock=self.clock)

    @cached_property
    def series(self) -> SeriesReader:
        return SeriesReader(tables=self.tables, devices=self.devices, keep=self.retention_policy, clock=self.clock)
