"""Fixtures of the movement tests."""

import pytest

from tests.harness.cloud.cloud import Cloud, Person


@pytest.fixture
def anna(alone: Cloud) -> Person:
    return alone.sign_in("anna")
