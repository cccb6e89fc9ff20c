from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.contract.transports.suite import Spoken
from tests.harness.cloud.cloud_processes import CloudProcesses, Link


@pytest.fixture
def spoken(request: pytest.FixtureRequest) -> Spoken:
    """The transport under test: an attribute of the class that inherits the suite."""
    found: Spoken = request.cls.spoken
    return found


@pytest.fixture
def processes(spoken: Spoken, start_processes: Callable[[Any], CloudProcesses]) -> CloudProcesses:
    return start_processes(spoken.broker)


@pytest.fixture
def link(processes: CloudProcesses, spoken: Spoken) -> Iterator[Link]:
    """A transport that is not yet started."""
    with Link(processes, spoken.configuration) as link:
        yield link


@pytest.fixture
def fragile(processes: CloudProcesses, spoken: Spoken) -> Iterator[Link]:
    """Like ``link``, through a proxy in front of its endpoint."""
    with Link(processes, spoken.configuration, through=spoken.endpoint) as link:
        yield link
