"""The API against a model: requests, acks and time in any order that Hypothesis generates."""

from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from device_agent.protocol import AckStatus
from tests.harness.cloud.cloud import MOVE, Cloud, Person
from tests.harness.cloud.cloud import settings as cloud_settings
from tests.harness.cloud.memory import NO_FOLDER, Memory
from tests.harness.cloud.polling import PollingRobot

TERMINAL = {"done", "failed", "expired", "cancelled"}
WAITING = {"queued"}
TTL_S, TIMEOUT_S, QUEUE_S, LEASE_S = 2, 6, 10, 5
ORPHAN_S = 70
PEOPLE = st.sampled_from(["anna", "again", "bert"])


class Machine(RuleBasedStateMachine):
    """One device, two sessions of its owner and a stranger; the owner may change."""

    def __init__(self) -> None:
        super().__init__()
        self.memory = Memory()
        self.cloud = Cloud(cloud_settings(NO_FOLDER), memory=self.memory)
        self.robot = PollingRobot(self.cloud, "arm")
        self.owner = ""
        self.epoch = 0
        self.mine: tuple[str, int, int] | None = None  # who took the lease by name, its epoch, and its end
        self.ends: dict[str, str] = {}
        self.open: dict[str, None] = {}
        self.keys: dict[tuple[str, str], str] = {}

    @initialize()
    def begin(self) -> None:
        anna = self.cloud.sign_in("anna")
        again, bert = self.cloud.sign_in("anna"), self.cloud.sign_in("bert")
        self.people: dict[str, Person] = {"anna": anna, "again": again, "bert": bert}
        self.pair("anna")

    def pair(self, name: str) -> None:
        self.robot.pair(self.people[name])
        self.owner = self.people[name].account
        self.mine, self.keys = None, {}

    def may(self, name: str) -> bool:
        return self.people[name].account == self.owner

    def now_ms(self) -> int:
        return self.cloud.clock.now_ms()

    @rule(name=PEOPLE)
    def take(self, name: str) -> None:
        answer = self.people[name].take_lease(self.robot.device, wait_ms=0, lease_ms=1000 * LEASE_S)
        if not self.may(name):
            assert answer.status_code == 404
        elif answer.status_code == 200:
            assert not self.held_by_other(name), "two live leases"
            assert answer.json()["epoch"] > self.epoch
            self.epoch = answer.json()["epoch"]
            self.mine = (name, self.epoch, self.now_ms() + 1000 * LEASE_S)
        else:
            assert answer.status_code == 409, answer.text
            lease = self.people[name].get(f"/devices/{self.robot.device}/lease").json()["lease"]
            assert lease is None or not lease["mine"]

    def held_by_other(self, name: str) -> bool:
        return self.mine is not None and self.mine[0] != name and self.now_ms() < self.mine[2] - 1000

    @rule(name=PEOPLE)
    def release(self, name: str) -> None:
        epoch = self.mine[1] if self.mine else 1
        path = f"/devices/{self.robot.device}/lease"
        answer = self.people[name].request("DELETE", path, params={"epoch": epoch})
        if answer.status_code == 204:
            # It may be the lease of an action of theirs.
            assert self.mine is None or self.mine[0] == name or self.now_ms() >= self.mine[2]
            self.mine = None
        else:
            assert answer.status_code == (409 if self.may(name) else 404)

    @rule(name=PEOPLE, key=st.sampled_from(["", "k1", "k2"]), policy=st.sampled_from(["reject", "queue"]))
    def start(self, name: str, key: str, policy: str) -> None:
        asked: dict[str, Any] = {
            "ttl_ms": 1000 * TTL_S, "timeout_ms": 1000 * TIMEOUT_S, "queue_ms": 1000 * QUEUE_S, "policy": policy
        }  # fmt: skip
        idempotency = {"idempotency_key": f"{key}{policy}"} if key else {}
        answer = self.people[name].start(self.robot.device, request=MOVE, **asked, **idempotency)
        if not self.may(name):
            assert answer.status_code == 404
            return
        known = self.keys.get((self.owner, f"{key}{policy}")) if key else None
        if answer.status_code in {200, 202}:
            action = answer.json()
            assert known in {None, action["id"]}, "the same key, another action"
            if key:
                self.keys[self.owner, f"{key}{policy}"] = action["id"]
            if known is None:
                assert policy == "queue" or not self.held_by_other(name)
                self.epoch = max(self.epoch, action["epoch"])
                self.open[action["id"]] = None
        else:
            assert answer.status_code == 409, answer.text
            assert known is None

    @precondition(lambda self: self.open)
    @rule(data=st.data(), status=st.sampled_from(list(AckStatus)), again=st.booleans())
    def report(self, data: st.DataObject, status: AckStatus, again: bool) -> None:
        """Of any action, in any order, doubled, late."""
        action = data.draw(st.sampled_from(list(self.open)))
        for _ in range(2 if again else 1):
            answer = self.robot.post_ack(action, status)
            assert answer["status"] in {"stored", "rejected"}, answer

    @precondition(lambda self: self.open)
    @rule(data=st.data(), name=PEOPLE)
    def cancel(self, data: st.DataObject, name: str) -> None:
        action = data.draw(st.sampled_from(list(self.open)))
        answer = self.people[name].post(f"/actions/{action}/cancel")
        assert answer.status_code in ({202} if self.may(name) else {404})

    @rule(seconds=st.sampled_from([0.5, 1.5, 4, 12]))
    def pass_time(self, seconds: float) -> None:
        self.cloud.clock.advance(seconds)
        self.cloud.sweep()

    @rule(name=PEOPLE)
    def unpair(self, name: str) -> None:
        answer = self.people[name].delete(f"/agents/{self.robot.id}")
        assert answer.status_code == (204 if self.may(name) else 404)
        if answer.status_code == 204:
            self.open = {}
            self.pair("bert" if name != "bert" else "anna")

    @invariant()
    def look(self) -> None:
        if not self.owner:
            return
        for person in self.people.values():
            answer = person.get(f"/devices/{self.robot.device}/actions", params={"limit": 200})
            if person.account != self.owner:
                assert answer.status_code == 404, "accounts cannot read each other's resources"
                continue
            items = answer.json()["items"]
            assert set(self.open) == {item["id"] for item in items}
            running = [item for item in items if item["status"] not in TERMINAL | WAITING | {"unknown"}]
            assert len(running) <= 1, "one device runs one action at a time"
            for item in items:
                first = self.ends.setdefault(item["id"], item["status"]) if item["status"] in TERMINAL else None
                assert item["status"] == (first or self.ends.get(item["id"], item["status"])), "the first end stays"
                self.epoch = max(self.epoch, item["epoch"])

    def teardown(self) -> None:
        try:
            if self.owner:
                for _ in range(TIMEOUT_S + QUEUE_S):
                    self.pass_time(1.5)
                self.pass_time(ORPHAN_S)
                for action in self.open.keys() - self.ends.keys():
                    self.robot.post_ack(action, AckStatus.DONE)
                self.look()
                assert set(self.open) <= set(self.ends), "with time everything ends"
        finally:
            self.cloud.__exit__()
            self.memory.loop.end()


def explore(*, examples: int, steps: int, seeded: bool) -> None:
    run_state_machine_as_test(
        Machine,
        settings=settings(
            max_examples=examples, stateful_step_count=steps, derandomize=seeded, database=None,
            phases=[Phase.generate], suppress_health_check=list(HealthCheck),
        ),
    )  # fmt: skip


@pytest.mark.slow
def test_the_invariants_hold_for_every_sequence() -> None:
    explore(examples=12, steps=25, seeded=True)


@pytest.mark.long
@pytest.mark.timeout(3_600)
def test_the_invariants_hold_for_many_long_sequences() -> None:
    explore(examples=500, steps=60, seeded=False)
