"""Faults are injected into running processes, and end again."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from benchmarks.faults.launcher import ProcessFaults, faults_file

PROGRAM = """
import sqlite3, sys, time
import jwt

database = sqlite3.connect(sys.argv[1], isolation_level=None)
database.execute("CREATE TABLE IF NOT EXISTS t (a)")
print("ready", flush=True)
for line in sys.stdin:
    try:
        database.execute("INSERT INTO t VALUES (1)")
        written = "written"
    except sqlite3.OperationalError as error:
        written = str(error)
    token = jwt.encode({"exp": int(line)}, "k" * 32, "HS256")
    try:
        jwt.decode(token, "k" * 32, ["HS256"])
        valid = "valid"
    except jwt.ExpiredSignatureError:
        valid = "expired"
    print(round(time.time()), valid, written, sep=";", flush=True)
"""
DAY_S = 86_400


@pytest.fixture
def program(tmp_path: Path) -> Iterator["subprocess.Popen[str]"]:
    (tmp_path / "faulty.py").write_text(PROGRAM)
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{Path.cwd()}", "TELESCOPE_HOME": str(tmp_path)}
    command = [sys.executable, "-m", "benchmarks.faults.launcher", "faulty", str(tmp_path / "t.db")]
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
        process.kill()


def test_a_process_gets_another_clock_and_tables_without_writes(
    program: "subprocess.Popen[str]", tmp_path: Path
) -> None:
    def ask(faults: ProcessFaults) -> list[str]:
        faults_file(tmp_path, program.pid).write_bytes(msgspec.json.encode(faults))
        program.send_signal(signal.SIGUSR1)
        assert program.stdin is not None
        assert program.stdout is not None
        print(round(time.time()) + DAY_S, file=program.stdin, flush=True)
        return program.stdout.readline().strip().split(";")

    seconds, valid, written = ask(ProcessFaults(clock_s=400 * DAY_S, read_only=True))
    assert int(seconds) - time.time() == pytest.approx(400 * DAY_S, abs=60)
    assert (valid, written) == ("expired", "attempt to write a readonly database")
    seconds, *others = ask(ProcessFaults())
    assert int(seconds) == pytest.approx(time.time(), abs=60)
    assert others == ["valid", "written"]


LIMITED = """
import os, resource, signal
from benchmarks.faults.injection import _used

kind = resource.{kind}
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(kind, (_used(kind, os.getpid()), resource.getrlimit(kind)[1]))
try:
    {use}
except (OSError, MemoryError):
    print("limited")
"""


@pytest.mark.parametrize(
    ("kind", "use"),
    [
        ("RLIMIT_NOFILE", "[os.dup(0) for _ in range(1_000)]"),  # some numbers below the limit are free
        ("RLIMIT_AS", "bytearray(1 << 28)"),
        ("RLIMIT_FSIZE", "print('x', file=open('limit', 'w'), flush=True)"),
    ],
)
def test_the_present_use_is_a_limit(kind: str, use: str, tmp_path: Path) -> None:
    # A new process: the test's own may have freed memory that it can use again below the limit.
    program = [sys.executable, "-c", LIMITED.format(kind=kind, use=use)]
    environment = os.environ | {"PYTHONPATH": str(Path.cwd())}
    output = subprocess.check_output(program, cwd=tmp_path, env=environment, text=True)
    assert output == "limited\n"
