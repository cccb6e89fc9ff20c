"""Checks that stores and broker are usable."""

from dataclasses import dataclass

from function_app.ports.command_bus import CommandBus
from function_app.ports.tables import StoreError, Tables
from function_app.services.robot_types.rows import read_refusal
from function_app.services.storage import records


@dataclass(frozen=True, slots=True)
class Health:
    """``ok`` or an error text for each dependency. ``usable``: whether the tables can be used."""

    tables: str
    broker: str
    models: str = "ok"
    usable: bool = True


class ReadinessCheck:
    """Checks dependencies."""

    def __init__(self, *, tables: Tables, bus: CommandBus) -> None:
        self._tables = tables
        self._bus = bus

    async def check(self) -> Health:
        """Read a row and check the bus."""
        try:
            await self.require_tables()
        except StoreError as error:
            return Health(tables=str(error), broker=await self._bus.status(), usable=False)
        problems = await self._tables.check()
        refusal = await read_refusal(self._tables)
        tables = " ".join(problems) or "ok"
        return Health(tables=tables, broker=await self._bus.status(), models=refusal or "ok")

    async def require_tables(self) -> None:
        """Read a row, and check that the store is still the one that was opened."""
        await self._tables.get(records.ACCOUNTS, "health", "health")
