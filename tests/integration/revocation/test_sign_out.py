"""Effects of signing out on broker connections."""

from collections.abc import Callable

import pytest

from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.network.brokers import BROKERS, RunningBroker, wait_until
from tests.integration.revocation.connections import connect


@pytest.mark.parametrize("broker", BROKERS, indirect=True)
def test_signing_out_ends_only_the_sessions_own_connections(
    cloud: Cloud, broker: RunningBroker, pair: tuple[Person, Robot]
) -> None:
    anna, _ = pair
    elsewhere = cloud.sign_in("anna")
    with connect(broker, anna, purpose="view") as here, connect(broker, elsewhere, purpose="view") as there:
        assert anna.post("/auth/sign-out").status_code == 204
        wait_until(here.disconnected.is_set, "the end of the connection")
        assert not there.disconnected.is_set()
        assert there.subscribe(elsewhere.post("/mqtt/credentials", {"purpose": "view"}).json()["subscribe"][0]) == [1]


def test_signing_out_works_while_the_broker_is_down(open_cloud: Callable[..., Cloud]) -> None:
    anna = open_cloud(at=None).sign_in("anna")
    assert anna.post("/auth/sign-out").status_code == 204
    assert anna.get("/accounts/me").status_code == 401
