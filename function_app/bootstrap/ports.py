"""The adapters as the ports that services take."""

from function_app.adapters.factory import Adapters
from function_app.ports.clock import Clock
from function_app.settings import Settings


class Ports:
    """Settings, clock and adapters of one installation."""

    def __init__(self, settings: Settings, adapters: Adapters, clock: Clock) -> None:
        self.settings = settings
        self.adapters = adapters
        self.clock = clock
        self.keys = adapters.keys
        self.tables = adapters.tables
        self.blobs = adapters.blobs
        self.access = adapters.access
        self.bus = adapters.bus
        self.certificates = adapters.certificates
        self.catalogue = adapters.catalogue
        self.transfers = adapters.transfers
        self.feed = adapters.feed
        self.telemetry = adapters.telemetry
        self.late = adapters.late
        self.metrics = adapters.metrics

    async def close(self) -> None:
        """Close all connections."""
        for adapter in (self.bus, self.access, self.tables, self.blobs, self.keys, self.certificates):
            await adapter.close()
