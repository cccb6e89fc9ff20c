"""Hostile scripts against the real sandbox, with the agent as an ordinary user and as root: none has an effect."""

import json
import os
from collections.abc import Callable, Iterator

import pytest

from device_agent.sandbox.constants import LANDLOCK, LIMITS, SECCOMP, USER
from tests.security.sandbox.attack_host import Result
from tests.security.sandbox.attack_runner import AttackRunner
from tests.security.sandbox.attacks import ATTACKS, PRELUDE

USERS = ["user", "root"] if os.geteuid() == 0 else ["user"]
BY_UNTRUSTED = [
    "reads_the_agents_key", "reads_the_agents_memory", "asks_whether_a_file_is_there", "writes_to_the_temporary_folder",
    "fills_the_disk", "connects_by_tcp", "connects_to_an_abstract_socket", "makes_a_socket_pair", "forks",
    "starts_a_thread", "becomes_a_shell", "kills_the_agent", "kills_the_warm_parent", "traces_a_process",
    "becomes_root", "becomes_root_of_a_new_user_namespace", "mounts", "switches_seccomp_off", "loads_a_bpf_program",
    "finds_a_descriptor_of_the_agent", "takes_all_memory", "ignores_every_signal", "moves_without_the_api",
]  # fmt: skip
"""Attacks that are repeated behind bubblewrap, as scripts of another account."""
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
"""Remaining layers, and attacks that then succeed if the agent is an ordinary user."""


def require_kill(result: Result) -> None:
    assert result.killed
    assert "ended before the script did" in result.message


def require_little_load(result: Result) -> None:
    require_kill(result)
    assert result.cpu_s < 0.7 * result.wall_s
    assert result.messages <= 600 + 600 * result.wall_s


def require_finite_moves(result: Result) -> None:
    assert result.moves
    json.dumps(result.moves, allow_nan=False)


def require_no_move(result: Result) -> None:
    assert result.moves == []


REQUIREMENTS: dict[str, Callable[[Result], None]] = {
    "computes_for_ever": require_kill,
    "sleeps_for_ever": require_kill,
    "ignores_every_signal": require_kill,
    "closes_its_socket": require_kill,
    "prints_for_ever": require_little_load,
    "asks_for_ever": require_little_load,
    "never_reads_its_answers": require_little_load,
    "says_progress_for_ever": require_little_load,
    "moves_without_the_api": require_finite_moves,
    "moves_after_it_has_ended": require_no_move,
}
"""Requirements in addition to those of every attack."""


@pytest.fixture(scope="module", params=USERS)
def runner(request: pytest.FixtureRequest) -> Iterator[AttackRunner]:
    with AttackRunner(root=request.param == "root") as runner:
        yield runner


def require_harmless(name: str, result: Result) -> None:
    assert result.breaches == []
    assert result.tried, result.message
    if name in REQUIREMENTS:
        REQUIREMENTS[name](result)


@pytest.mark.parametrize("name", ATTACKS)
def test_attack(runner: AttackRunner, name: str) -> None:
    require_harmless(name, runner.attack(name))


@pytest.mark.parametrize("name", BY_UNTRUSTED)
def test_attack_of_an_unknown_owner(runner: AttackRunner, name: str) -> None:
    require_harmless(name, runner.attack(name, untrusted=True))


@pytest.mark.parametrize(("layers", "names"), WITHOUT.values(), ids=list(WITHOUT))
def test_with_less_than_all_layers_attacks_succeed(layers: tuple[str, ...], names: list[str]) -> None:
    with AttackRunner(root=False, layers=layers) as weak:
        assert [name for name in names if not weak.attack(name).breaches] == []


def test_a_script_cannot_influence_the_next_one(runner: AttackRunner) -> None:
    runner.attack("leaves_a_surprise_for_the_next_script")
    result = runner.run(
        "next",
        f"{PRELUDE}import builtins, json, math, os\n"
        "if hasattr(builtins, 'print_before') or os.environ.get('SURPRISE'): breach('left behind')\n"
        "json.dumps(math.pi)\n",
    )
    require_harmless("next", result)
    assert result.message == ""
