"""Requests of the sharing tests."""

from typing import Any

from function_app.ports.broker_access import Credentials
from tests.fakes.broker import MemoryBroker, MemoryConnection
from tests.harness.cloud.cloud import Person

SHARED_S = 120


def share(owner: Person, on: str, person: Person, role: str, **more: Any) -> dict[str, Any]:
    """Share ``devices/<id>`` or ``spaces/<id>``."""
    answer = owner.post(f"/{on}/shares", {"account": person.name, "role": role, **more})
    assert answer.status_code in {200, 201}, answer.text
    shown: dict[str, Any] = answer.json()
    return shown


def unshare(owner: Person, on: str, person: Person) -> None:
    assert owner.delete(f"/{on}/shares/{person.account}").status_code == 204


def devices(person: Person) -> dict[str, str]:
    """Id → role, over all pages of one agent each."""
    return {item["id"]: item["role"] for item in person.pages("/devices", limit=1)}


def connected(broker: MemoryBroker, person: Person, purpose: str = "view", **more: Any) -> MemoryConnection:
    """A connection of a person, with credentials for this purpose."""
    issued = person.post("/mqtt/credentials", {"purpose": purpose, **more}).json()
    client = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
    assert client.connected.is_set(), client.answer
    return client
