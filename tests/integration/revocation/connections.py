"""Broker connections of people, for the revocation tests."""

from typing import Any

from function_app.ports.broker_access import Credentials
from tests.harness.cloud.cloud import Person
from tests.harness.network.brokers import Client, RunningBroker


def request_credentials(person: Person, **purpose: Any) -> tuple[str, Credentials]:
    """The client id and the credentials that the API issues for a purpose."""
    issued = person.post("/mqtt/credentials", purpose).json()
    return issued["client_id"], Credentials(issued["username"], issued["password"])


def connect(broker: RunningBroker, person: Person, **purpose: Any) -> Client:
    client = broker.connect(*request_credentials(person, **purpose))
    assert client.connected.is_set(), client.answer
    return client
