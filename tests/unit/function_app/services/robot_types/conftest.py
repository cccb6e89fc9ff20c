"""Fixtures of the movement tests."""

import pytest

from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import Cloud, Person


@pytest.fixture
def alone(open_cloud: OpenCloud) -> Cloud:
    return open_cloud()


@pytest.fixture
def anna(alone: Cloud) -> Person:
    return alone.sign_in("anna")
