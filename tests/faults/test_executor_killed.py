"""The executor under ``kill -9`` at any step: no command runs twice or stays without a final state."""

import json
import random
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent.protocol import AckStatus, CancelAction, Command, GrantLease, MoveJoints, RunMovement
from device_agent.protocol.security import signing
from tests.faults.mortal_agent import AGENT, DEVICE, SPACE, TARGET_RAD, Life
from tests.harness.agent.device_harness import signed_movement
from tests.harness.paths import ROOT

LIVES = 30
"""Number of consecutive runs on one journal; the last one is not killed."""
NEW_ORDERS = 4
TTL_MS = 10_000
_MOST_STEPS = 150
_SLOW = 0.03
"""Speed share at which a move takes one second, long enough for a cancellation."""
Agent = Any


@pytest.fixture(scope="module")
def agent() -> Iterator[Agent]:
    with subprocess.Popen(
        [sys.executable, "-m", "tests.faults.mortal_agent"],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as parent:  # fmt: skip
        yield parent
        assert parent.stdin is not None
        parent.stdin.close()


class Cloud:
    """A cloud and a journal: issued commands and their results."""

    def __init__(self, agent: Agent, folder: Path, seed: int) -> None:
        folder.mkdir()
        self.folder = folder
        self.chance = random.Random(seed)
        self.key = signing.generate()
        self.agent = agent
        self.orders: dict[str, Command] = {}
        self.cloud_ms = 1_000_000
        self.epoch = 0
        self.kills = 0

    def order(self, request: Any) -> Command:
        number = len(self.orders)
        command = Command(
            id=f"c{number}", space=SPACE, agent=AGENT, device=DEVICE, issued_at_ms=self.cloud_ms, ttl_ms=TTL_MS,
            caller="ann", epoch=self.epoch, request=request,
        )  # fmt: skip
        self.orders[command.id] = command
        return command

    def new_orders(self) -> list[Command]:
        """Moves to distinct targets, with some scripts, cancelled slow moves, and leases."""
        made = []
        for _ in range(NEW_ORDERS):
            self.epoch += 1
            elbow = {"elbow": len(self.orders) * TARGET_RAD}
            kind = self.chance.random()
            if kind < 0.15:
                slow = self.order(MoveJoints(position_rad=elbow | {"shoulder": 3.0}, speed=_SLOW))
                made += [slow, self.order(CancelAction(action=slow.id))]
            elif kind < 0.3:
                source = f"progress(0.5)\nrobot.move_joints({elbow}, speed=1.0)\n"
                made.append(self.order(signed_movement(source, self.key)))
            elif kind < 0.4:
                made.append(self.order(GrantLease(holder="ann", lease_ms=5000)))
            else:
                made.append(self.order(MoveJoints(position_rad=elbow, speed=1.0)))
        return made

    def live(self, *, last: bool) -> None:
        open_orders = [order for order in self.orders.values() if order.id not in self.ends()]
        ended = [order for order in self.orders.values() if order.id in self.ends()]
        again = open_orders + self.chance.sample(ended, min(3, len(ended)))
        self.chance.shuffle(again)
        new = [] if last else self.new_orders()
        arriving = again + new + self.chance.choices(again + new, k=3) if again or new else []
        life = Life(
            folder=str(self.folder),
            key=self.key.private_bytes_raw(),
            dies_at=None if last else self.chance.randrange(_MOST_STEPS),
            cloud_ms=self.cloud_ms,
            seed=self.chance.randrange(2**32),
            orders=arriving,
        )
        print(msgspec.json.encode(life).decode(), file=self.agent.stdin, flush=True)
        code = int(self.agent.stdout.readline())
        assert code in ({0} if last else {0, -9}), f"the life ended with {code}"
        self.kills += code == -9
        self.cloud_ms += self.chance.choice((50, 200, TTL_MS // 2))

    def rows(self, name: str) -> list[dict[str, Any]]:
        path = self.folder / name
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def ends(self) -> dict[str, set[tuple[str, str]]]:
        """Distinct final states published for each command."""
        found: dict[str, set[tuple[str, str]]] = {}
        for row in self.rows("heard"):
            if AckStatus(row["status"]).terminal:
                found.setdefault(row["id"], set()).add((row["status"], row["code"]))
        return found

    def check(self) -> Counter[str]:
        ends = self.ends()
        assert set(ends) == set(self.orders), f"without an end: {set(self.orders) - set(ends)}"
        assert all(len(each) == 1 for each in ends.values()), "a command with two ends"
        moves = Counter(f"c{row['number']}" for row in self.rows("moved"))
        assert max(moves.values(), default=0) <= 1, f"done twice: {moves.most_common(3)}"
        for row in self.rows("moved"):
            order = self.orders[f"c{row['number']}"]
            assert row["cloud_ms"] <= order.issued_at_ms + order.ttl_ms + SLACK_MS, "begun after its time"
        done = {command for command, each in ends.items() if ("done", "") in each}
        asked_to_move = {
            name for name, order in self.orders.items() if isinstance(order.request, MoveJoints | RunMovement)
        }
        assert done & asked_to_move <= set(moves), "said to be done, and never begun"
        said = Counter(status if code == "" else code for each in ends.values() for status, code in each)
        return said + Counter({"progress": sum(row["progress"] == 0.5 for row in self.rows("heard"))})


SLACK_MS = 1000
"""Tolerance from the clock check to the first motor command on a busy machine [ms]."""


def lead(agent: Agent, folder: Path, journals: int, *, seed: int) -> Counter[str]:
    said: Counter[str] = Counter()
    for number in range(journals):
        cloud = Cloud(agent, folder / f"{seed}-{number}", seed + number)
        for life in range(LIVES):
            cloud.live(last=life == LIVES - 1)
        said += cloud.check() + Counter({"kills": cloud.kills, "orders": len(cloud.orders)})
    print(dict(said.most_common()))
    return said


def test_a_kill_never_repeats_a_command_or_leaves_it_without_an_end(agent: Agent, tmp_path: Path) -> None:
    said = lead(agent, tmp_path, 2, seed=4)
    assert said["kills"] > 25
    assert {"done", "cancelled", "expired", "agent_restarted", "progress"} <= set(said), "too few things happened"


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_a_thousand_kills_never_repeat_a_command_or_leave_it_without_an_end(agent: Agent, tmp_path: Path) -> None:
    said: Counter[str] = Counter()
    seed = 1000
    while said["kills"] < 1000:
        said += lead(agent, tmp_path, 5, seed=seed)
        seed += 5
    print(dict(said.most_common()))
