import itertools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from function_app.adapters.local.signing_keys import FileKeys
from tests.harness.network.brokers import RunningBroker, start_broker


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Signing keys that the broker knows."""
    folder = tmp_path_factory.mktemp("api") / "keys"
    FileKeys(folder).load()
    return folder


@pytest.fixture(scope="session")
def broker(keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningBroker]:
    with start_broker("amqtt", tmp_path_factory.mktemp("broker"), keys=keys / "public.json") as running:
        yield running


@pytest.fixture
def new_home(tmp_path: Path, keys: Path) -> Callable[[], Path]:
    """Makes folders for functions that the broker knows, with nothing else in them."""
    numbers = itertools.count()

    def made() -> Path:
        folder = tmp_path / f"home{next(numbers)}"
        shutil.copytree(keys, folder / "keys")
        return folder

    return made


@pytest.fixture
def home(new_home: Callable[[], Path]) -> Path:
    return new_home()
