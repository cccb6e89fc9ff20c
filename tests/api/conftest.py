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
    """Creates home folders with the keys that the broker accepts."""
    numbers = itertools.count()

    def make() -> Path:
        folder = tmp_path / f"home{next(numbers)}"
        shutil.copytree(keys, folder / "keys")
        return folder

    return make
