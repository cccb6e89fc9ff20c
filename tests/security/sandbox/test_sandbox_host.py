"""The zygote starts clean, is replaced after a kill, ends with its agent, and reports missing layers."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.ports.sandbox import Limits, SandboxError, SandboxProcess
from device_agent.sandbox import host
from device_agent.sandbox.host import SandboxHost
from tests.harness.network.brokers import PATIENCE_S, wait_until
from tests.harness.paths import ROOT
from tests.security.sandbox.attack_host import zygotes


@pytest.fixture
def sandbox() -> Iterator[SandboxHost]:
    sandbox = SandboxHost()
    sandbox.start()
    yield sandbox
    sandbox.close()


def run_script(process: SandboxProcess, source: str) -> str:
    """Runs a script and returns its messages and why it ended."""
    with contextlib.closing(process), process.link.makefile("rwb") as lines:
        assert json.loads(lines.readline()) == {"kind": "ready"}
        task = {"source": source, "name": "x", "parameters": {}, "joints": [], "frames": [], "can": []}
        lines.write(json.dumps(task).encode() + b"\n")
        lines.flush()
        messages = ""
        with contextlib.suppress(OSError):
            messages = lines.read().decode()
        assert process.wait(PATIENCE_S)
        return messages + process.ending()


def zygote_of(sandbox: SandboxHost) -> int:
    process = sandbox._own._process
    assert process is not None
    assert process.pid in zygotes()
    return process.pid


def has_ended(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0] in "ZX"
    return True


def test_the_zygote_inherits_nothing_of_the_agent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TELESCOPE_SECRET", "x")
    with open("/proc/self/cmdline", "rb") as inherited:  # noqa: PTH123 (a descriptor that could be inherited)
        os.set_inheritable(inherited.fileno(), True)
        sandbox = SandboxHost()
        assert sandbox.refusal(untrusted=False) is None
    zygote = zygote_of(sandbox)
    environment = Path(f"/proc/{zygote}/environ").read_bytes()
    assert b"TELESCOPE" not in environment
    assert b"HOME" not in environment
    wait_until(
        lambda: {entry.name for entry in Path(f"/proc/{zygote}/fd").iterdir()} == {"0", "1", "2", "3"}, "the processes"
    )
    assert os.getsid(zygote) == zygote
    sandbox.close()


def test_a_killed_zygote_is_replaced(sandbox: SandboxHost) -> None:
    running = sandbox.open(Limits(), untrusted=False)
    os.kill(zygote_of(sandbox), signal.SIGKILL)
    assert running.wait(PATIENCE_S), "the processes must end with the zygote"
    assert running.ending() in {"", "the script sandbox has ended"}
    running.close()
    assert "7" in run_script(sandbox.open(Limits(), untrusted=False), "print(3 + 4)")


def test_an_unresponsive_zygote_is_killed_and_replaced(sandbox: SandboxHost, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host, "_RESPONSE_S", 0.1)
    monkeypatch.setattr(host, "_PREPARE_AFTER_S", 2 * PATIENCE_S)
    sandbox.open(Limits(), untrusted=False).close()  # the prepared process
    control = sandbox._own._control
    assert control is not None
    control.settimeout(0.1)
    stuck = zygote_of(sandbox)
    os.kill(stuck, signal.SIGSTOP)
    with pytest.raises(SandboxError, match="does not respond"):
        sandbox.open(Limits(), untrusted=False)
    assert has_ended(stuck)
    monkeypatch.setattr(host, "_RESPONSE_S", 20.0)
    assert "7" in run_script(sandbox.open(Limits(), untrusted=False), "print(3 + 4)")


def ready(sandbox: SandboxHost) -> host._HostedProcess:
    wait_until(lambda: sandbox._own.ready is not None, "a prepared process")
    assert sandbox._own.ready is not None
    return sandbox._own.ready[1]


def test_a_process_is_prepared_for_each_script(sandbox: SandboxHost) -> None:
    pids = set()
    for number in range(3):
        prepared = ready(sandbox)
        pids.add(prepared.pid)
        process = sandbox.open(Limits(), untrusted=False)
        assert process is prepared
        assert str(number) in run_script(process, f"print({number})")
    assert len(pids) == 3, "each script must have a separate process"


def test_a_process_prepared_for_other_limits_is_not_used(sandbox: SandboxHost) -> None:
    prepared = ready(sandbox)
    with contextlib.closing(sandbox.open(Limits(cpu_s=7), untrusted=False)) as process:
        assert isinstance(process, host._HostedProcess)
        assert process.pid != prepared.pid
        assert b"ready" in process.link.recv(100)
        assert f"Max cpu time              {7} " in Path(f"/proc/{process.pid}/limits").read_text(encoding="ascii")
    assert has_ended(prepared.pid)


def test_a_dead_prepared_process_is_replaced_and_close_kills_it(sandbox: SandboxHost) -> None:
    prepared = ready(sandbox)
    os.kill(prepared.pid, signal.SIGKILL)
    assert prepared.wait(PATIENCE_S)
    assert "7" in run_script(sandbox.open(Limits(), untrusted=False), "print(3 + 4)")
    prepared = ready(sandbox)
    sandbox.close()
    assert has_ended(prepared.pid)
    sandbox.close()
    assert "1" in run_script(sandbox.open(Limits(), untrusted=False), "print(1)"), (
        "the sandbox must start again on demand"
    )


def test_all_processes_end_with_a_killed_agent() -> None:
    program = (
        "import os, sys\n"
        "from device_agent.sandbox.host import SandboxHost\n"
        "from device_agent.ports.sandbox import Limits\n"
        "sandbox = SandboxHost()\n"
        "processes = [sandbox.open(Limits(), untrusted=untrusted) for untrusted in (False, True)]\n"
        "print(sandbox._own._process.pid, sandbox._wrapped._process.pid, processes[0].pid, flush=True)\n"
        "sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT) as agent:
        assert agent.stdout is not None
        pids = [int(pid) for pid in agent.stdout.readline().split()]
        assert len(pids) == 3
        agent.kill()
        wait_until(lambda: all(has_ended(pid) for pid in pids), "the end of all processes")


def test_processor_time_is_limited(sandbox: SandboxHost) -> None:
    ending = run_script(sandbox.open(Limits(cpu_s=1), untrusted=False), "while True: pass")
    assert ending.endswith("it used up its processor time, or the machine's memory")


def test_scripts_of_other_accounts_are_rejected_without_bubblewrap(
    sandbox: SandboxHost, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    refusal = sandbox.refusal(untrusted=True)
    assert refusal is not None
    assert "apt-get install bubblewrap" in refusal
    with pytest.raises(SandboxError, match="bubblewrap"):
        sandbox.open(Limits(), untrusted=True)
    assert sandbox.refusal(untrusted=False) is None


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("platform", "win32", "Linux only"), ("executable", "/nowhere/python", "does not start")],
)
def test_missing_platform_features_are_a_refusal(
    name: str, value: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, name, value)
    sandbox = SandboxHost()
    sandbox.start()
    assert message in (sandbox.refusal(untrusted=False) or "")


WEAK_KERNEL = """
import errno, json, sys
import pyseccomp
blocked = pyseccomp.SyscallFilter(pyseccomp.ALLOW)
blocked.add_rule(pyseccomp.ERRNO(errno.ENOSYS), "{blocked}")
blocked.load()
from device_agent.sandbox.host import SandboxHost
from device_agent.ports.sandbox import Limits
from tests.security.sandbox.test_sandbox_host import run_script
strict, lenient = SandboxHost(), SandboxHost(allow_unconfined=True)
print(json.dumps([strict.refusal(untrusted=False), lenient.refusal(untrusted=False)]), flush=True)
print(run_script(lenient.open(Limits(), untrusted=False), "print(3 + 4)"), flush=True)
try:
    strict.open(Limits(), untrusted=False)
except Exception as error:
    print(type(error).__name__, flush=True)
strict.close(); lenient.close()
"""


@pytest.mark.parametrize("blocked", ["landlock_create_ruleset", "landlock_restrict_self", "seccomp"])
def test_scripts_are_rejected_if_the_kernel_lacks_a_layer_unless_allowed(blocked: str) -> None:
    command = [sys.executable, "-c", WEAK_KERNEL.format(blocked=blocked)]
    completed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    refusals, messages, error = completed.stdout.strip().split("\n", 2)
    strict, lenient = json.loads(refusals)
    assert f"no {blocked.partition('_')[0]}" in strict
    assert "allow_unconfined_scripts = true" in strict
    assert lenient is None
    assert "7" in messages
    assert "SandboxError" in error


def test_a_bubblewrap_that_cannot_start_is_reported_as_the_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host, "_bubblewrap", lambda: ("false",))
    with contextlib.closing(SandboxHost()) as sandbox:
        assert sandbox.refusal(untrusted=False) is None
        assert "bubblewrap, which cannot start on this machine" in (sandbox.refusal(untrusted=True) or "")
        with pytest.raises(SandboxError, match="cannot start"):
            sandbox.open(Limits(), untrusted=True)
