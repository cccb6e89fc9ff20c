"""All stores and hosts return the same responses to the same requests."""

import difflib
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.api.conversation import PUBLIC_URL, Conversation
from tests.conftest import Emulators
from tests.harness.cloud.people import sign_in_links
from tests.harness.hosts import HostKind, start_host
from tests.harness.network.brokers import RunningBroker
from tests.harness.stores.aws import use_credentials
from tests.harness.stores.emulators import StoreKind, empty_store, make_places

Run = Callable[[StoreKind, HostKind, Path], list[str]]


@pytest.fixture
def run(broker: RunningBroker, emulators: Emulators, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Sends all requests to a host with an empty store; returns the transcript."""

    def transcript(store: StoreKind, kind: HostKind, home: Path) -> list[str]:
        if store == "aws":
            use_credentials(monkeypatch)
        environment = {
            "TELESCOPE_HOME": str(home),
            "TELESCOPE_PUBLIC_URL": PUBLIC_URL,
            "TELESCOPE_MQTT_PORT": str(broker.tcp_port),
            **empty_store(store, emulators(store)),
        }
        make_places(home, environment)
        links = sign_in_links(environment, "anna", "anna", "bert")
        with start_host(kind, environment) as host:
            return Conversation(host, links).run()

    return transcript


@pytest.fixture(scope="module")
def first() -> list[str]:
    """The transcript of the reference store and host; filled by the first test."""
    return []


COMBINATIONS = [
    ("local", "azure"),
    ("local", "lambda"),
    ("azure", "uvicorn"),
    ("aws", "uvicorn"),
    *(
        pytest.param(store, kind, marks=pytest.mark.sampled)
        for store in ("azure", "aws")
        for kind in ("azure", "lambda")
    ),
]


@pytest.mark.parametrize(("store", "kind"), COMBINATIONS)
def test_the_responses_are_the_same(
    run: Run, first: list[str], new_home: Callable[[], Path], store: StoreKind, kind: HostKind
) -> None:
    if not first:
        first += run("local", "uvicorn", new_home())
        assert len(first) > 150
    transcript = run(store, kind, new_home())
    differences = list(difflib.unified_diff(first, transcript, "local, uvicorn", f"{store}, {kind}", lineterm="", n=0))
    assert not differences, "\n".join(differences[:40])
