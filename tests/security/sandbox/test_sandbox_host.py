"""The warm parent: starts clean, is replaced when it dies, dies with its agent, and says when it cannot lock."""

import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from device_agent.ports.sandbox import JailError, Limits, SandboxProcess
from device_agent.sandbox import host
from device_agent.sandbox.host import SandboxHost
from tests.security.sandbox.captor import warm_parents
from tests.security.sandbox.halves import REPOSITORY

WITHIN_S = 60.0


@pytest.fixture
def jail() -> Iterator[SandboxHost]:
    jail = SandboxHost()
    jail.start()
    yield jail
    jail.close()


def play(inmate: SandboxProcess, source: str) -> str:
    """What a script prints, and its end."""
    with contextlib.closing(inmate), inmate.link.makefile("rwb") as lines:
        assert json.loads(lines.readline()) == {"kind": "ready"}
        task = {"source": source, "name": "x", "parameters": {}, "joints": [], "frames": [], "can": []}
        lines.write(json.dumps(task).encode() + b"\n")
        lines.flush()
        said = ""
        with contextlib.suppress(OSError):
            said = lines.read().decode()
        assert inmate.wait(WITHIN_S)
        return said + inmate.ending()


def eventually(probe: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + WITHIN_S
    while not probe():
        assert time.monotonic() < deadline_s, "it never happened"
        time.sleep(0.01)


def parent_of(jail: SandboxHost) -> int:
    (found,) = [pid for pid in warm_parents() if pid == _process(jail).pid]
    return found


def _process(jail: SandboxHost) -> "subprocess.Popen[bytes]":
    process = jail._own._process
    assert process is not None
    return process


def dead(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0] in "ZX"
    return True


def test_the_warm_parent_holds_nothing_of_the_agents(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TELESCOPE_SECRET", "x")
    with open("/proc/self/cmdline", "rb") as inherited:  # noqa: PTH123 (a descriptor that could be inherited)
        os.set_inheritable(inherited.fileno(), True)
        jail = SandboxHost()
        assert jail.refusal(stranger=False) is None
    parent = parent_of(jail)
    environment = Path(f"/proc/{parent}/environ").read_bytes()
    assert b"TELESCOPE" not in environment
    assert b"HOME" not in environment
    eventually(lambda: {entry.name for entry in Path(f"/proc/{parent}/fd").iterdir()} == {"0", "1", "2", "3"})
    assert os.getsid(parent) == parent
    jail.close()


def test_a_parent_that_was_killed_is_replaced(jail: SandboxHost) -> None:
    running = jail.open(Limits(), stranger=False)
    os.kill(parent_of(jail), signal.SIGKILL)
    assert running.wait(WITHIN_S), "its children die with it"
    assert running.ending() in {"", "the jail of scripts has ended"}
    running.close()
    assert "7" in play(jail.open(Limits(), stranger=False), "print(3 + 4)")


def test_a_parent_that_no_longer_answers_is_given_up_and_replaced(
    jail: SandboxHost, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host, "_ANSWER_S", 0.1)
    monkeypatch.setattr(host, "_PREPARE_AFTER_S", 2 * WITHIN_S)
    jail.open(Limits(), stranger=False).close()  # the one that is ready
    control = jail._own._control
    assert control is not None
    control.settimeout(0.1)
    stuck = parent_of(jail)
    os.kill(stuck, signal.SIGSTOP)
    with pytest.raises(JailError, match="does not answer"):
        jail.open(Limits(), stranger=False)
    assert dead(stuck)
    monkeypatch.setattr(host, "_ANSWER_S", 20.0)
    assert "7" in play(jail.open(Limits(), stranger=False), "print(3 + 4)")


def ready(jail: SandboxHost) -> host._Inmate:
    eventually(lambda: jail._own.ready is not None)
    assert jail._own.ready is not None
    return jail._own.ready[1]


def test_a_process_is_ready_for_each_script(jail: SandboxHost) -> None:
    seen = set()
    for number in range(3):
        waiting = ready(jail)
        inmate = jail.open(Limits(), stranger=False)
        assert inmate is waiting
        seen.add(waiting.pid)
        assert str(number) in play(inmate, f"print({number})")
    assert len(seen) == 3, "none runs a second script"


def test_one_that_is_ready_for_other_limits_is_not_taken(jail: SandboxHost) -> None:
    waiting = ready(jail)
    with contextlib.closing(jail.open(Limits(cpu_s=7), stranger=False)) as inmate:
        assert isinstance(inmate, host._Inmate)
        assert inmate.pid != waiting.pid
        assert b"ready" in inmate.link.recv(100)
        assert f"Max cpu time              {7} " in Path(f"/proc/{inmate.pid}/limits").read_text(encoding="ascii")
    assert dead(waiting.pid)


def test_one_that_died_while_it_was_ready_is_replaced(jail: SandboxHost) -> None:
    waiting = ready(jail)
    os.kill(waiting.pid, signal.SIGKILL)
    assert waiting.wait(WITHIN_S)
    assert "7" in play(jail.open(Limits(), stranger=False), "print(3 + 4)")


def test_the_one_that_is_ready_ends_with_the_jail(jail: SandboxHost) -> None:
    waiting = ready(jail)
    jail.close()
    assert dead(waiting.pid)


def test_all_of_it_dies_with_an_agent_that_is_killed() -> None:
    program = (
        "import os, sys\n"
        "from device_agent.sandbox.host import WarmJail\n"
        "from device_agent.ports.sandbox import Limits\n"
        "jail = WarmJail()\n"
        "inmates = [jail.open(Limits(), stranger=stranger) for stranger in (False, True)]\n"
        "print(jail._own._process.pid, jail._walled._process.pid, inmates[0].pid, flush=True)\n"
        "sys.stdin.read()\n"
    )
    agent = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=REPOSITORY
    )
    with agent:
        assert agent.stdout is not None
        pids = [int(pid) for pid in agent.stdout.readline().split()]
        assert len(pids) == 3
        agent.kill()
        for pid in pids:
            eventually(lambda pid=pid: dead(pid))  # type: ignore[misc]


def test_processor_time_is_limited(jail: SandboxHost) -> None:
    said = play(jail.open(Limits(cpu_s=1), stranger=False), "while True: pass")
    assert said.endswith("it used up its processor time, or the machine's memory")


def test_a_closed_jail_may_be_closed_again_and_opened(jail: SandboxHost) -> None:
    jail.close()
    jail.close()
    assert "1" in play(jail.open(Limits(), stranger=False), "print(1)")


def test_scripts_of_strangers_are_refused_without_bubblewrap(
    jail: SandboxHost, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    refusal = jail.refusal(stranger=True)
    assert refusal is not None
    assert "apt-get install bubblewrap" in refusal
    with pytest.raises(JailError, match="bubblewrap"):
        jail.open(Limits(), stranger=True)
    assert jail.refusal(stranger=False) is None


def test_other_systems_than_linux_refuse_scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    refusal = SandboxHost().refusal(stranger=False)
    assert refusal is not None
    assert "Linux only" in refusal


def test_a_python_that_cannot_start_is_a_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    jail = SandboxHost()
    jail.start()
    refusal = jail.refusal(stranger=False)
    assert refusal is not None
    assert "does not start" in refusal


WEAK_KERNEL = """
import errno, json, sys
import pyseccomp
blocked = pyseccomp.SyscallFilter(pyseccomp.ALLOW)
blocked.add_rule(pyseccomp.ERRNO(errno.ENOSYS), "{blocked}")
blocked.load()
from device_agent.sandbox.host import WarmJail
from device_agent.ports.sandbox import Limits
from tests.security.sandbox.test_sandbox_host import play
careful, trusting = WarmJail(), WarmJail(trusted=True)
print(json.dumps([careful.refusal(stranger=False), trusting.refusal(stranger=False)]), flush=True)
print(play(trusting.open(Limits(), stranger=False), "print(3 + 4)"), flush=True)
try:
    careful.open(Limits(), stranger=False)
except Exception as error:
    print(type(error).__name__, flush=True)
careful.close(); trusting.close()
"""


@pytest.mark.parametrize(
    ("blocked", "layer"),
    [("landlock_create_ruleset", "landlock"), ("landlock_restrict_self", "landlock"), ("seccomp", "seccomp")],
)
def test_where_the_kernel_lacks_a_layer_scripts_are_refused_unless_they_are_trusted(blocked: str, layer: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WEAK_KERNEL.format(blocked=blocked)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    refusals, said, error = done.stdout.strip().split("\n", 2)
    careful, trusting = json.loads(refusals)
    assert f"no {layer}" in careful
    assert "allow_unconfined_scripts = true" in careful
    assert trusting is None
    assert "7" in said
    assert "JailError" in error


def started_ms(jail: SandboxHost) -> float:
    begun_s = time.perf_counter()
    with contextlib.closing(jail.open(Limits(), stranger=False)) as inmate, inmate.link.makefile("rb") as lines:
        assert json.loads(lines.readline()) == {"kind": "ready"}
        return (time.perf_counter() - begun_s) * 1000


def test_a_warm_start_takes_a_small_part_of_a_cold_one() -> None:
    cold, warm_ = [], []
    for _ in range(12):  # as a rule three are enough; what else the machine does may fall on any of them
        with contextlib.closing(SandboxHost()) as jail:
            cold.append(started_ms(jail))
            warm_ += [started_ms(jail) for _ in range(5)]
        if len(cold) > 2 and statistics.median(warm_) < 0.5 * statistics.median(cold):
            return
    pytest.fail(f"cold starts take {cold} ms, warm ones {warm_} ms")


def stopped_ms(jail: SandboxHost, source: str) -> float:
    with contextlib.closing(jail.open(Limits(), stranger=False)) as inmate, inmate.link.makefile("rwb") as lines:
        lines.readline()
        task = {"source": source, "name": "x", "parameters": {}, "joints": [], "frames": [], "can": []}
        lines.write(json.dumps(task).encode() + b"\n")
        lines.flush()
        assert b"output" in lines.readline()
        begun_s = time.perf_counter()
        inmate.kill()
        assert inmate.wait(WITHIN_S)
        return (time.perf_counter() - begun_s) * 1000


def test_a_script_that_ignores_signals_dies_as_soon_as_one_that_sleeps(jail: SandboxHost) -> None:
    stubborn = (
        "import signal\nfor number in (1, 2, 15): signal.signal(number, signal.SIG_IGN)\nprint(1)\nwhile True: pass"
    )
    asleep, awake = [], []
    for _ in range(60):  # as a rule fifteen are enough
        asleep.append(stopped_ms(jail, "print(1)\nwait(600)"))
        awake.append(stopped_ms(jail, stubborn))
        if len(awake) > 14 and statistics.median(awake) < 10 * statistics.median(asleep) + 10:
            return
    pytest.fail(f"one that sleeps takes {asleep} ms, one that ignores signals {awake} ms")
