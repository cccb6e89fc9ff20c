"""Whether the functions can do their work."""

from dataclasses import dataclass

from function_app.ports.command_bus import CommandBus
from function_app.ports.tables import StoreError, Tables
from function_app.services.storage import records


@dataclass(frozen=True, slots=True)
class Health:
    """``ok`` or a sentence, for each thing that the functions need."""

    tables: str
    broker: str


class ReadinessCheck:
    """Looks."""

    def __init__(self, *, tables: Tables, bus: CommandBus) -> None:
        self._tables = tables
        self._bus = bus

    async def check(self) -> Health:
        """Read a row, and ask the bus."""
        try:
            await self.require_tables()
        except StoreError as error:
            return Health(tables=str(error), broker=await self._bus.status())
        return Health(tables="ok", broker=await self._bus.status())

    async def require_tables(self) -> None:
        """Read a row.

        Raises:
            StoreError: The tables cannot be used.
        """
        await self._tables.get(records.ACCOUNTS, "health", "health")
