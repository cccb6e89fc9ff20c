"""The plan of one simulation: what people do and which faults occur, and when. A seed decides all of it."""

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

DURATION_S = 20.0
"""Time in which steps begin [s]."""
PEOPLE = ("anna", "bert", "carl")
AGENTS = ("robot1", "robot2")
DEVICES = (0, 1, 2)
"""Devices: two behind the first agent, which Anna owns and Carl may operate; one behind the second, Bert's."""
HOUR_MS = 3_600_000
JUMPS_MS = (HOUR_MS, -HOUR_MS, 400 * 24 * HOUR_MS)


@dataclass(frozen=True, slots=True)
class Step:
    """One operation of a person (``who``) or one fault (``who`` is empty)."""

    number: int
    at_s: float
    kind: str
    who: str = ""
    arguments: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        values = " ".join(f"{key}={value}" for key, value in self.arguments.items())
        return f"{self.number:3}  {self.at_s:7.3f} s  {self.who or 'fault':6} {self.kind} {values}".rstrip()


Draw = Callable[[random.Random], dict[str, Any]]


def _start(rng: random.Random) -> dict[str, Any]:
    return {
        "policy": rng.choice(("reject", "queue")),
        "to_rad": round(rng.uniform(-2.5, 2.5), 3),
        "ttl_ms": rng.choice((500, 2000, 5000)),
        "timeout_ms": rng.choice((2000, 6000)),
        "wait_ms": rng.choice((0, 500, 4000)),
        "with_lease": rng.random() < 0.4,
        "retries": rng.choice((0, 2)),
    }


OPERATIONS: dict[str, tuple[float, Draw]] = {
    "acquire": (3, lambda rng: {"lease_ms": rng.choice((1500, 4000, 5000))}),
    "renew": (2, lambda rng: {"lease_ms": rng.choice((1500, 4000))}),
    "release": (1.5, lambda _: {}),
    "take_over": (0.7, lambda _: {"lease_ms": 4000}),
    "hand_over": (1, lambda _: {}),
    "stream": (
        3,
        lambda rng: {
            "for_s": round(rng.uniform(0.3, 2.0), 3),
            "gap_ms": rng.choice((30, 60)),
            "stubborn": rng.random() < 0.3,
        },
    ),
    "start": (7, _start),
    "burst": (1, _start),
    "cancel": (1, lambda _: {}),
    "stop": (1, lambda _: {}),
    "reset": (1.5, lambda _: {}),
    "read": (1, lambda _: {}),
    "share": (0.7, lambda rng: {"role": rng.choice(("operator", "viewer", ""))}),
    "snoop": (0.5, lambda _: {}),
    "unpair": (0.12, lambda _: {}),
}
"""Operations: weight, and arguments."""


def _agent(rng: random.Random) -> str:
    return rng.choice(AGENTS)


def _for_s(rng: random.Random, least_s: float, most_s: float) -> float:
    return round(rng.uniform(least_s, most_s), 3)


FAULTS: dict[str, Draw] = {
    "kill_function": lambda rng: {"index": rng.randrange(2), "after": rng.randint(1, 40)},
    "kill_worker": lambda rng: {"after": rng.randint(1, 60), "for_s": _for_s(rng, 0.2, 4.0)},
    "suspend_worker": lambda rng: {"for_s": _for_s(rng, 0.5, 6.0)},
    "kill_broker": lambda rng: {"for_s": _for_s(rng, 0.1, 4.0)},
    "kill_agent": lambda rng: {"agent": _agent(rng), "after": rng.choice((0, rng.randint(1, 30)))},
    "power_failure": lambda rng: {"agent": _agent(rng)},
    "suspend_agent": lambda rng: {"agent": _agent(rng), "for_s": _for_s(rng, 0.1, 3.0)},
    "partition": lambda rng: {
        "pair": rng.choice(
            (
                (_agent(rng), "broker"),
                ("cloud", "broker"),
                (_agent(rng), "cloud"),
                (rng.choice(PEOPLE), "cloud"),
                (rng.choice(PEOPLE), "broker"),
            )
        ),
        "direction": rng.choice(("both", "to", "from")),
        "for_s": _for_s(rng, 0.2, 10.0),
    },
    "slow_network": lambda rng: {
        "machine": rng.choice((*AGENTS, "cloud", *PEOPLE)),
        "delay_s": rng.choice((0.05, 0.3, 1.5)),
        "for_s": _for_s(rng, 1.0, 8.0),
    },
    "reorder": lambda rng: {"machine": rng.choice((*AGENTS, "cloud")), "for_s": _for_s(rng, 2.0, 12.0)},
    "duplicate": lambda rng: {"machine": rng.choice((*AGENTS, "cloud")), "for_s": _for_s(rng, 2.0, 12.0)},
    "cloud_clock": lambda rng: {"jump_ms": rng.choice(JUMPS_MS)},
    "agent_clock": lambda rng: {"agent": _agent(rng), "jump_ms": rng.choice(JUMPS_MS)},
    "full_disk": lambda rng: {"agent": _agent(rng), "for_s": _for_s(rng, 0.3, 6.0)},
    "restore": lambda rng: {"age_s": _for_s(rng, 1.0, 12.0)},
    "slow_driver": lambda rng: {
        "agent": _agent(rng),
        "slow_s": rng.choice((0.03, 0.1)),
        "for_s": _for_s(rng, 0.5, 3.0),
    },
    "broken_driver": lambda rng: {"agent": _agent(rng), "for_s": _for_s(rng, 0.1, 2.0)},
}


def create(seed: int) -> list[Step]:
    """The plan of a seed, in order of time. Each plan uses a few kinds of faults only."""
    rng = random.Random(f"plan {seed}")
    drafts: list[tuple[float, str, str, dict[str, Any]]] = []
    kinds, weights = list(OPERATIONS), [weight for weight, _ in OPERATIONS.values()]
    shared = rng.choice(((0,), (0, 0, 0, 1)))  # some plans use one device only, so that operators compete
    for _ in range(rng.randint(12, 36)):
        kind = rng.choices(kinds, weights)[0]
        who = rng.choice(PEOPLE)
        own = (2,) if who == "bert" else shared
        others = (0,) if who == "bert" else (2,)
        arguments = {"device": rng.choice(others if kind == "snoop" else own), **OPERATIONS[kind][1](rng)}
        drafts.append((round(rng.uniform(0.0, DURATION_S), 3), kind, who, arguments))
    enabled = rng.sample(list(FAULTS), rng.randint(1, 4))
    for _ in range(rng.choice((0, 1, 2, 3, 4, 6))):
        kind = rng.choice(enabled)
        drafts.append((round(rng.uniform(1.0, DURATION_S), 3), kind, "", FAULTS[kind](rng)))
    drafts.sort(key=lambda draft: draft[:3])
    return [Step(number, *draft) for number, draft in enumerate(drafts)]
