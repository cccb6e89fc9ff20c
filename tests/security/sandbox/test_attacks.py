"""Hostile scripts against the real sandbox, with the agent as an ordinary user and as root: none gets anywhere."""

import math
import os
from collections.abc import Iterator
from typing import Any

import pytest

from device_agent.sandbox.constants import LANDLOCK, LIMITS, SECCOMP, USER
from tests.security.sandbox.attack_host import Result
from tests.security.sandbox.attack_runner import AttackRunner, inside
from tests.security.sandbox.attacks import ATTACKS

USERS = ["user", "root"] if os.geteuid() == 0 else ["user"]
ENDLESS = [
    "computes_for_ever", "sleeps_for_ever", "ignores_every_signal", "prints_for_ever", "asks_for_ever",
    "never_reads_its_answers", "says_progress_for_ever", "closes_its_socket",
]  # fmt: skip
FLOODS = ["prints_for_ever", "asks_for_ever", "never_reads_its_answers", "says_progress_for_ever"]
BY_UNTRUSTED = [
    "reads_the_agents_key", "reads_the_agents_memory", "asks_whether_a_file_is_there", "writes_to_the_temporary_folder",
    "fills_the_disk", "connects_by_tcp", "connects_to_an_abstract_socket", "makes_a_socket_pair", "forks",
    "starts_a_thread", "becomes_a_shell", "kills_the_agent", "kills_the_warm_parent", "traces_a_process",
    "becomes_root", "becomes_root_of_a_new_user_namespace", "mounts", "switches_seccomp_off", "loads_a_bpf_program",
    "finds_a_descriptor_of_the_agent", "takes_all_memory", "ignores_every_signal", "moves_without_the_api",
]  # fmt: skip
"""A part of all, once more behind bubblewrap."""
WITHOUT = {
    "no layer": ((), [
        "reads_the_agents_key", "reads_the_agents_memory", "writes_over_the_agents_key", "connects_by_tcp",
        "connects_to_an_abstract_socket", "becomes_a_shell", "starts_a_thread", "takes_a_descriptor_of_the_agent",
        "stops_a_process_of_the_agents_user", "becomes_root_of_a_new_user_namespace", "unpickles_a_command",
    ]),
    "no seccomp": ((LIMITS, USER, LANDLOCK), [
        "asks_whether_a_file_is_there", "asks_how_the_machine_is_called", "makes_a_memory_file",
        "runs_machine_code_of_its_own", "becomes_root_of_a_new_user_namespace",
    ]),
    "neither Landlock nor seccomp": ((LIMITS, USER), [
        "reads_the_passwords", "listens_by_tcp", "connects_to_an_abstract_socket", "stops_a_process_of_the_agents_user",
    ]),
    "no limits": ((USER, LANDLOCK, SECCOMP), ["takes_memory_past_python"]),
}  # fmt: skip
"""The layers that are left, and attacks that then succeed where the agent is an ordinary user: what each is for."""


@pytest.fixture(scope="module", params=USERS)
def runner(request: pytest.FixtureRequest) -> Iterator[AttackRunner]:
    started = AttackRunner(root=request.param == "root")
    yield started
    started.close()


def require_harmless(result: Result) -> None:
    assert result.breaches == []
    assert result.tried, result.message


@pytest.mark.parametrize("name", ATTACKS)
def test_attack(runner: AttackRunner, name: str) -> None:
    require_harmless(runner.attack(name))


@pytest.mark.parametrize("name", BY_UNTRUSTED)
def test_attack_of_an_unknown_owner(runner: AttackRunner, name: str) -> None:
    require_harmless(runner.attack(name, untrusted=True))


@pytest.mark.parametrize(("layers", "names"), WITHOUT.values(), ids=list(WITHOUT))
def test_with_less_than_all_layers_attacks_succeed(layers: tuple[str, ...], names: list[str]) -> None:
    weak = AttackRunner(root=False, layers=layers)
    try:
        assert [name for name in names if not weak.attack(name).breaches] == []
    finally:
        weak.close()


@pytest.mark.parametrize("name", ENDLESS)
def test_what_does_not_end_is_ended(runner: AttackRunner, name: str) -> None:
    result = runner.attacked(name)
    assert result.killed_ms > 0
    assert "ended before the script did" in result.message


@pytest.mark.parametrize("name", FLOODS)
def test_a_flood_costs_the_agent_little(runner: AttackRunner, name: str) -> None:
    result = runner.attacked(name)
    assert result.cpu_s < 0.7 * result.wall_s
    assert result.messages <= 600 + 600 * result.wall_s


def test_what_a_lying_process_says_of_numbers_never_reaches_the_robot_unless_finite(runner: AttackRunner) -> None:
    moves = runner.attacked("moves_without_the_api").moves
    assert moves
    assert all(math.isfinite(number) for move in moves for number in numbers(move))


def test_nothing_moves_after_the_end(runner: AttackRunner) -> None:
    assert runner.attacked("moves_after_it_has_ended").moves == []


def test_a_script_finds_nothing_of_the_one_before(runner: AttackRunner) -> None:
    runner.attack("leaves_a_surprise_for_the_next_script")
    result = runner.run(
        "next",
        inside(
            "import builtins, json, math, os\n"
            "if hasattr(builtins, 'print_before') or os.environ.get('SURPRISE'): breach('left behind')\n"
            "json.dumps(math.pi)\n"
        ),
    )
    require_harmless(result)
    assert result.message == ""


def numbers(value: Any) -> Iterator[float]:
    if isinstance(value, dict):
        for each in value.values():
            yield from numbers(each)
    elif isinstance(value, float | int):
        yield value
