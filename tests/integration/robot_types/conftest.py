"""Fixtures of the tests of robot types."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fakes.clock import MovingClock
from tests.harness.cloud.cloud import Cloud, Person, settings
from tests.integration.robot_types.lever import checking


@pytest.fixture
def cloud(home: Path) -> Iterator[Cloud]:
    """The functions without a broker and without a model checker."""
    with Cloud(settings(home), clock=MovingClock()) as cloud:
        yield cloud


@pytest.fixture
def anna(cloud: Cloud) -> Person:
    return cloud.sign_in("anna")


@pytest.fixture
def checker(cloud: Cloud) -> Iterator[None]:
    with checking(cloud):
        yield


@pytest.fixture(scope="module")
def bert(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Person]:
    """A person whose uploads are checked; shared by tests that only add versions."""
    with Cloud(settings(tmp_path_factory.mktemp("home")), clock=MovingClock()) as cloud, checking(cloud):
        yield cloud.sign_in("bert")
