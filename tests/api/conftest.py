import itertools
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fixtures.brokers import Brokers
from tests.harness.network.brokers import RunningBroker


@pytest.fixture
def broker(brokers: Brokers) -> RunningBroker:
    return brokers("amqtt")


@pytest.fixture
def new_home(tmp_path: Path, keys: Path) -> Callable[[], Path]:
    """Makes empty folders of functions that the broker knows."""
    numbers = itertools.count()

    def make() -> Path:
        folder = tmp_path / f"home{next(numbers)}"
        shutil.copytree(keys, folder / "keys")
        return folder

    return make
