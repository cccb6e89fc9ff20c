import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from function_app.settings import Settings
from tests.fixtures.brokers import Brokers
from tests.harness.cloud.cloud import Cloud, Person, settings
from tests.harness.network.brokers import RunningBroker
from tests.harness.network.xmpp import XmppRobot, XmppSite, open_site


@pytest.fixture(scope="module")
def broker(brokers: Brokers) -> RunningBroker:
    return brokers("amqtt")


@pytest.fixture(scope="module")
def site(broker: RunningBroker, keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[XmppSite]:
    """Functions with their ingest, Prosody and a gateway for the tests of a module."""
    folder = tmp_path_factory.mktemp("home")
    shutil.copytree(keys, folder / "keys")
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
    """A robot of Anna's that is online."""
    with site.robot() as robot:
        robot.pair(anna)
        yield robot.connect()
