import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from function_app.adapters.local.signing_keys import FileKeys
from function_app.settings import Settings
from tests.harness.cloud.cloud import Cloud, Person, settings
from tests.harness.network.brokers import BrokerKind, RunningBroker, start_broker
from tests.harness.network.xmpp import XmppRobot, XmppSite, open_site

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module", params=["amqtt"])
def broker(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningBroker]:
    """One broker for the tests of a file."""
    kind: BrokerKind = request.param
    folder = tmp_path_factory.mktemp("home")
    FileKeys(folder / "keys").load()
    home = folder / "mosquitto" if kind == "mosquitto" else folder / "broker"
    with start_broker(kind, home, keys=folder / "keys" / "public.json") as broker:
        broker.folder = folder  # type: ignore[attr-defined]
        yield broker


@pytest.fixture(scope="module")
def site(broker: RunningBroker) -> Iterator[XmppSite]:
    """Functions with their ingest, Prosody, and one who speaks for the cloud: for the tests of a file."""
    folder: Path = broker.folder  # type: ignore[attr-defined]
    with contextlib.ExitStack() as stack:

        def opened(known: Settings) -> Cloud:
            cloud = stack.enter_context(Cloud(known))
            cloud.start_ingest()
            return cloud

        with open_site(opened, settings(folder, broker), folder / "prosody") as site:
            yield site


@pytest.fixture
def anna(site: XmppSite) -> Person:
    return site.cloud.sign_in("anna")


@pytest.fixture
def robot(site: XmppSite, anna: Person) -> Iterator[XmppRobot]:
    """Anna's, and there."""
    with site.robot() as robot:
        robot.pair(anna)
        yield robot.connect()
