import contextlib
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from function_app.adapters.local import tables as adapter
from function_app.adapters.local.signing_keys import FileKeys
from function_app.adapters.local.tables import SqliteTables
from tests.conftest import Emulators
from tests.fakes.agent import Robot
from tests.fakes.clock import MovingClock
from tests.harness.cloud.cloud import Cloud, Person, paired, settings
from tests.harness.crash_injection import CutTables, Knife
from tests.harness.network.brokers import BrokerKind, RunningBroker, start_broker
from tests.harness.processes import Place
from tests.harness.stores.aws import use_credentials
from tests.harness.stores.emulators import StoreKind, empty_store, make_places

OpenCloud = Callable[..., Cloud]
Mortal = Callable[[MovingClock], tuple[Cloud, Knife]]


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Signing keys that the brokers of this session know."""
    folder = tmp_path_factory.mktemp("functions") / "keys"
    FileKeys(folder).load()
    return folder


@pytest.fixture(scope="session")
def brokers(keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[BrokerKind], RunningBroker]]:
    """One broker of a kind for all tests, started when the first one needs it."""
    running: dict[BrokerKind, RunningBroker] = {}
    with contextlib.ExitStack() as stack:

        def start(kind: BrokerKind) -> RunningBroker:
            if kind not in running:
                folder = tmp_path_factory.mktemp(kind)
                running[kind] = stack.enter_context(start_broker(kind, folder, keys=keys / "public.json"))
            return running[kind]

        yield start


@pytest.fixture
def broker(request: pytest.FixtureRequest, brokers: Callable[[BrokerKind], RunningBroker]) -> RunningBroker:
    """The embedded one; a test that is parametrised with ``broker`` runs over others too."""
    return brokers(getattr(request, "param", "amqtt"))


@pytest.fixture
def home(tmp_path: Path, keys: Path) -> Path:
    folder = tmp_path / "home"
    shutil.copytree(keys, folder / "keys")
    return folder


@pytest.fixture
def open_cloud(home: Path, broker: RunningBroker) -> Iterator[OpenCloud]:
    """Opens instances of the functions over one home."""
    if broker.kind == "mosquitto":
        (home / "mosquitto").mkdir()
        shutil.copy(broker.home / "service.password", home / "mosquitto")
    with contextlib.ExitStack() as stack:

        def opened(*, at: RunningBroker | None = broker, **options: Any) -> Cloud:
            return stack.enter_context(Cloud(settings(home, at), **options))

        yield opened


@pytest.fixture
def cloud(open_cloud: OpenCloud) -> Cloud:
    """The functions with their ingest."""
    cloud = open_cloud()
    cloud.start_ingest()
    return cloud


@pytest.fixture
def pair(cloud: Cloud) -> Iterator[tuple[Person, Robot]]:
    """Anna, and a robot of hers that is online."""
    with paired(cloud) as found:
        yield found


@pytest.fixture
def mortal(open_cloud: OpenCloud, monkeypatch: pytest.MonkeyPatch) -> Callable[[MovingClock], tuple[Cloud, Knife]]:
    """Opens another process over the same home, and the knife that ends it."""

    def opened(clock: MovingClock) -> tuple[Cloud, Knife]:
        knife = Knife()
        with monkeypatch.context() as patch:
            patch.setattr(adapter, "SqliteTables", lambda path: CutTables(SqliteTables(path), knife))
            return open_cloud(clock=clock), knife

    return opened


@pytest.fixture
def place(
    request: pytest.FixtureRequest, tmp_path: Path, emulators: Emulators, monkeypatch: pytest.MonkeyPatch
) -> Place:
    """An empty store of the kind that the test is parametrised with."""
    kind: StoreKind = request.param
    if kind == "aws":
        use_credentials(monkeypatch)
    environment = {"TELESCOPE_HOME": str(tmp_path), **empty_store(kind, emulators(kind))}
    make_places(tmp_path, environment)
    return Place(environment, time.time_ns() // 1_000_000, tmp_path / "sent")
