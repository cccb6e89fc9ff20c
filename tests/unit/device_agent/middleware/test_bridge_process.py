"""A bridge process that works, ends, hangs, or cannot be started."""

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.middleware import bridge_process
from device_agent.middleware.bridge_process import BridgeProcess
from device_agent.ports.driver import UnreachableError
from tests.harness.network.brokers import wait_until

ECHO = "import os\nwhile data := os.read(0, 65536): os.write(0, data)"


@contextlib.contextmanager
def bridge(folder: Path, program: str = ECHO) -> Iterator[BridgeProcess]:
    path = folder / "bridge.py"
    path.write_text(program, encoding="utf-8")
    with contextlib.closing(BridgeProcess("test bridge", sys.executable, path)) as process:
        yield process


def fill(process: BridgeProcess) -> None:
    """Send more than the socket can hold."""
    for _ in range(1000):
        process.send(b"1" * 10_000)


def test_messages_arrive_whole_and_in_order(tmp_path: Path) -> None:
    sent = [b"1" * 100_000, b"2"]
    received: list[bytes] = []
    with bridge(tmp_path) as process:
        for message in sent:
            process.send(message)

        def all_received() -> bool:
            received.extend(process.receive())
            return len(received) == len(sent)

        wait_until(all_received, "the messages")
    assert received == sent


def test_a_bridge_that_ended_is_named(tmp_path: Path) -> None:
    with bridge(tmp_path, "") as process:
        process.process.wait()
        with pytest.raises(ConnectionError, match=r"\Athe test bridge has ended\Z"):
            process.receive()
        with pytest.raises(ConnectionError, match=r"\Athe test bridge has ended\Z"):
            process.send(b"1")


def test_a_bridge_that_does_not_read_never_blocks_and_is_lost(tmp_path: Path) -> None:
    with bridge(tmp_path) as process:
        os.kill(process.process.pid, signal.SIGSTOP)
        with pytest.raises(ConnectionError, match=r"\Athe test bridge hangs\Z"):
            fill(process)
        with pytest.raises(ConnectionError, match=r"\Athe test bridge has ended\Z"):
            process.send(b"1")
        os.kill(process.process.pid, signal.SIGCONT)


def test_a_bridge_that_does_not_end_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bridge_process, "_END_S", 0.1)
    with bridge(tmp_path, "import time\ntime.sleep(1000)") as process:
        pass
    assert process.process.returncode == -signal.SIGKILL


def test_an_interpreter_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnreachableError, match="the Python of the test bridge cannot be started"):
        BridgeProcess("test bridge", str(tmp_path / "python"), tmp_path)
