"""An operator's XMPP client, as an application writes it with a standard library for XMPP."""

import itertools
import json
from typing import Any, Protocol

import httpx

from device_agent.protocol.xmpp import jids, operator_stanzas, stanzas
from device_agent.protocol.xmpp.operator_stanzas import Answer
from tests.harness.network.brokers import wait_until
from tests.harness.network.xmpp import XmppClient


class Account(Protocol):
    """A signed-in account."""

    account: str
    token: str

    def post(self, path: str, body: Any) -> httpx.Response: ...


class XmppOperator(XmppClient):
    """A signed-in operator.

    Args:
        port: Port of the XMPP server.
        person: The account.
        token: Access token; default: the person's.
        resource: Resource of the JID.
    """

    def __init__(self, port: int, person: Account, *, token: str = "", resource: str = "operator") -> None:
        issued = person.post("/xmpp/credentials", {"purpose": "view"}).json()
        super().__init__(port, person.account, issued["password"], resource=resource)
        assert self.opened, self.trouble
        self._numbers = itertools.count(1)
        self._token = token or person.token
        wait_until(lambda: self.is_available(jids.CLOUD), "the gateway")
        self.cloud = next(each.get("from", "") for each in self.presences if each.get("from", "").startswith("cloud@"))

    def sign_in(self) -> Answer:
        number = self._number()
        return self._ask(number, operator_stanzas.sign_in(self.cloud, number, self._token))

    def call(self, method: str, path: str, body: Any = None) -> tuple[int, Any]:
        """Status and decoded body of a call."""
        number = self._number()
        text = "" if body is None else json.dumps(body)
        answer = self._ask(number, operator_stanzas.call(self.cloud, number, method, f"/api/v1{path}", text))
        return answer.status, json.loads(answer.body) if answer.body else None

    def listen(self, *topics: str) -> Answer:
        number = self._number()
        return self._ask(number, operator_stanzas.listen(self.cloud, number, topics))

    def publish(self, topic: str, payload: bytes) -> None:
        self.send(stanzas.message(self.cloud, topic, payload))

    def received(self, topic: str) -> list[bytes]:
        found = (stanzas.parse(each) for each in list(self.messages))
        return [each.payload for each in found if each is not None and each.topic == topic and each.payload]

    def rejections(self) -> list[str]:
        found = (stanzas.parse_rejection(each) for each in list(self.messages))
        return [each.reason for each in found if each is not None]

    def _number(self) -> str:
        return str(next(self._numbers))

    def _ask(self, number: str, stanza: str) -> Answer:
        answers: list[Answer] = []

        def answered() -> bool:
            found = (operator_stanzas.parse_answer(each) for each in list(self.messages))
            answers[:] = [each for each in found if each is not None and each.id == number]
            return bool(answers)

        self.send(stanza)
        wait_until(answered, f"the answer to {stanza[:80]}")
        return answers[0]
