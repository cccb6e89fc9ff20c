"""``MemoryTables``, which the unit tests of the services use, fulfils the port's contract."""

import pytest

from function_app.ports.tables import Tables
from tests.contract.tables.suite import Again, TablesSuite
from tests.fakes.tables import MemoryTables


class TestMemoryTables(TablesSuite):
    @pytest.fixture
    def tables(self) -> Tables:
        return MemoryTables()

    @pytest.fixture
    def again(self, tables: MemoryTables) -> Again:
        return lambda: MemoryTables(tables)
