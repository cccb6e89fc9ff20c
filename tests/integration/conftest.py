import contextlib
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.conftest import Emulators
from tests.fakes.agent import Robot
from tests.fixtures.brokers import Brokers
from tests.harness.cloud.cloud import Cloud, Person, paired, settings
from tests.harness.cloud.memory import Memory
from tests.harness.network.brokers import RunningBroker
from tests.harness.processes import Place
from tests.harness.stores.aws import use_credentials
from tests.harness.stores.emulators import StoreKind, empty_store, make_places

OpenCloud = Callable[..., Cloud]


@pytest.fixture
def broker(request: pytest.FixtureRequest, brokers: Brokers) -> RunningBroker:
    """The embedded broker by default; tests may parametrize ``broker``."""
    return brokers(getattr(request, "param", "amqtt"))


@pytest.fixture
def open_cloud(home: Path, broker: RunningBroker) -> Iterator[OpenCloud]:
    """Opens instances of the functions with the same home folder."""
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
    """Anna and her online robot."""
    with paired(cloud) as found:
        yield found


@pytest.fixture
def place(
    request: pytest.FixtureRequest, tmp_path: Path, emulators: Emulators, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Place]:
    """An empty store of the parametrized kind."""
    kind: StoreKind | Literal["memory"] = request.param
    now_ms, sent = time.time_ns() // 1_000_000, tmp_path / "sent"
    if kind == "memory":
        memory = Memory()
        yield Place({"TELESCOPE_HOME": str(tmp_path)}, now_ms, sent, memory)
        memory.loop.end()
        return
    if kind == "aws":
        use_credentials(monkeypatch)
    environment = {"TELESCOPE_HOME": str(tmp_path), **empty_store(kind, emulators(kind))}
    make_places(tmp_path, environment)
    yield Place(environment, now_ms, sent)
