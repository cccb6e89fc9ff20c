"""Requests of the sharing tests."""

from typing import Any

from function_app.ports.broker_access import Credentials
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker, MemoryConnection
from tests.harness.cloud.cloud import Person

Three = tuple[Person, Person, Robot]
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
    found: dict[str, str] = {}
    cursor: str | None = ""
    while cursor is not None:
        page = person.get("/devices", params={"limit": 1} | ({"cursor": cursor} if cursor else {})).json()
        found |= {item["id"]: item["role"] for item in page["items"]}
        cursor = page["cursor"]
    return found


def watching(broker: MemoryBroker, person: Person) -> tuple[MemoryConnection, dict[str, Any]]:
    issued = person.post("/mqtt/credentials", {"purpose": "view"}).json()
    client = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
    assert client.connected.is_set(), client.answer
    return client, issued


def steering(broker: MemoryBroker, person: Person, device: str, epoch: int) -> MemoryConnection:
    issued = person.post("/mqtt/credentials", {"purpose": "control", "device": device, "epoch": epoch}).json()
    client = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
    assert client.connected.is_set(), client.answer
    return client
