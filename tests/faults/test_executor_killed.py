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
from tests.faults.killable_agent import AGENT, DEVICE, SPACE, TARGET_RAD, Run
from tests.harness.agent.device_harness import signed_movement
from tests.harness.paths import ROOT

RUNS = 30
"""Number of consecutive runs on one journal; the last one is not killed."""
NEW_COMMANDS = 4
TTL_MS = 10_000
_MOST_STEPS = 150
_SLOW = 0.03
"""Speed share at which a move takes one second, long enough for a cancellation."""
Agent = Any


@pytest.fixture(scope="module")
def agent() -> Iterator[Agent]:
    with subprocess.Popen(
        [sys.executable, "-m", "tests.faults.killable_agent"],
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
        self.rng = random.Random(seed)
        self.key = signing.generate()
        self.agent = agent
        self.commands: dict[str, Command] = {}
        self.cloud_ms = 1_000_000
        self.epoch = 0
        self.kills = 0

    def issue(self, request: Any) -> Command:
        number = len(self.commands)
        command = Command(
            id=f"c{number}", space=SPACE, agent=AGENT, device=DEVICE, issued_at_ms=self.cloud_ms, ttl_ms=TTL_MS,
            caller="ann", epoch=self.epoch, request=request,
        )  # fmt: skip
        self.commands[command.id] = command
        return command

    def new_commands(self) -> list[Command]:
        """Moves to distinct targets, with some scripts, cancelled slow moves, and leases."""
        created = []
        for _ in range(NEW_COMMANDS):
            self.epoch += 1
            elbow = {"elbow": len(self.commands) * TARGET_RAD}
            kind = self.rng.random()
            if kind < 0.15:
                slow = self.issue(MoveJoints(position_rad=elbow | {"shoulder": 3.0}, speed=_SLOW))
                created += [slow, self.issue(CancelAction(action=slow.id))]
            elif kind < 0.3:
                source = f"progress(0.5)\nrobot.move_joints({elbow}, speed=1.0)\n"
                created.append(self.issue(signed_movement(source, self.key)))
            elif kind < 0.4:
                created.append(self.issue(GrantLease(holder="ann", lease_ms=5000)))
            else:
                created.append(self.issue(MoveJoints(position_rad=elbow, speed=1.0)))
        return created

    def run(self, *, last: bool) -> None:
        open_commands = [command for command in self.commands.values() if command.id not in self.ends()]
        ended = [command for command in self.commands.values() if command.id in self.ends()]
        again = open_commands + self.rng.sample(ended, min(3, len(ended)))
        self.rng.shuffle(again)
        new = [] if last else self.new_commands()
        arriving = again + new + self.rng.choices(again + new, k=3) if again or new else []
        run = Run(
            folder=str(self.folder),
            key=self.key.private_bytes_raw(),
            kill_at_step=None if last else self.rng.randrange(_MOST_STEPS),
            cloud_ms=self.cloud_ms,
            seed=self.rng.randrange(2**32),
            commands=arriving,
        )
        print(msgspec.json.encode(run).decode(), file=self.agent.stdin, flush=True)
        code = int(self.agent.stdout.readline())
        assert code in ({0} if last else {0, -9}), f"the process exited with {code}"
        self.kills += code == -9
        self.cloud_ms += self.rng.choice((50, 200, TTL_MS // 2))

    def rows(self, name: str) -> list[dict[str, Any]]:
        path = self.folder / name
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def ends(self) -> dict[str, set[tuple[str, str]]]:
        """Distinct final states published for each command."""
        states: dict[str, set[tuple[str, str]]] = {}
        for row in self.rows("published"):
            if AckStatus(row["status"]).terminal:
                states.setdefault(row["id"], set()).add((row["status"], row["code"]))
        return states

    def check(self) -> Counter[str]:
        ends = self.ends()
        assert set(ends) == set(self.commands), f"without a final state: {set(self.commands) - set(ends)}"
        assert all(len(each) == 1 for each in ends.values()), "a command with two final states"
        moves = Counter(f"c{row['number']}" for row in self.rows("moved"))
        assert max(moves.values(), default=0) <= 1, f"executed twice: {moves.most_common(3)}"
        for row in self.rows("moved"):
            command = self.commands[f"c{row['number']}"]
            assert row["cloud_ms"] <= command.issued_at_ms + command.ttl_ms + SLACK_MS, "executed after its ttl"
        done = {command for command, each in ends.items() if ("done", "") in each}
        moving = {
            name for name, command in self.commands.items() if isinstance(command.request, MoveJoints | RunMovement)
        }
        assert done & moving <= set(moves), "reported as done without execution"
        counts = Counter(status if code == "" else code for each in ends.values() for status, code in each)
        return counts + Counter({"progress": sum(row["progress"] == 0.5 for row in self.rows("published"))})


SLACK_MS = 1000
"""Tolerance from the clock check to the first motor command on a busy machine [ms]."""


def run_journals(agent: Agent, folder: Path, journals: int, *, seed: int) -> Counter[str]:
    counts: Counter[str] = Counter()
    for number in range(journals):
        cloud = Cloud(agent, folder / f"{seed}-{number}", seed + number)
        for run in range(RUNS):
            cloud.run(last=run == RUNS - 1)
        counts += cloud.check() + Counter({"kills": cloud.kills, "commands": len(cloud.commands)})
    print(dict(counts.most_common()))
    return counts


def test_a_kill_never_repeats_a_command_or_leaves_it_without_an_end(agent: Agent, tmp_path: Path) -> None:
    counts = run_journals(agent, tmp_path, 2, seed=4)
    assert counts["kills"] > 25
    assert {"done", "cancelled", "expired", "agent_restarted", "progress"} <= set(counts), "too few kinds of results"


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_a_thousand_kills_never_repeat_a_command_or_leave_it_without_an_end(agent: Agent, tmp_path: Path) -> None:
    counts: Counter[str] = Counter()
    seed = 1000
    while counts["kills"] < 1000:
        counts += run_journals(agent, tmp_path, 5, seed=seed)
        seed += 5
    print(dict(counts.most_common()))
