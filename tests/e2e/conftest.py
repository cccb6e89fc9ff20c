from collections.abc import Iterator

import pytest

from tests.support.machine import Machine, start_machine


@pytest.fixture(scope="session")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """The product, started once for all tests that leave it as they found it."""
    with start_machine(tmp_path_factory.mktemp("machine")) as machine:
        assert machine.process.poll() is None, "".join(machine.lines)
        yield machine


@pytest.fixture(scope="session")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """The product with all that is in its laboratory, started once for all tests that leave it as they found it."""
    with start_machine(tmp_path_factory.mktemp("laboratory"), TELESCOPE_ROOM="lab") as machine:
        assert machine.process.poll() is None, "".join(machine.lines)
        yield machine
