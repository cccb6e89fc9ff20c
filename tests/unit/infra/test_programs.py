import contextlib
import importlib
import os
import subprocess
import sys

import pytest

from tests.harness.paths import ROOT

SUPERVISOR = """
import sys
from infra import programs

server = '''
import signal, socket, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
listener = socket.create_server(("127.0.0.1", int(__import__("sys").argv[1])))
time.sleep(600)
'''
(port,) = programs.free_ports(("127.0.0.1", 0))
command = [sys.executable, "-c", server, str(port)]
sys.exit(programs.supervise(programs.Server("server", command, "127.0.0.1", (port,)), ready="ready"))
"""


def test_a_server_that_ignores_sigterm_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", SUPERVISOR], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            process.terminate()
            assert process.wait(60.0) == 0
        finally:
            process.kill()


@pytest.mark.parametrize(
    "name",
    [
        "device_agent",
        "function_app",
        "infra.foxglove",
        *(f"infra.{name}" for name in ("embedded_broker", "home_assistant", "local", "mosquitto", "prosody", "tls")),
    ],
)
def test_programs_create_private_files(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    monkeypatch.setenv("TELESCOPE_PORT", "invalid")  # infra.local has no arguments
    with contextlib.suppress(SystemExit):
        importlib.import_module(f"{name}.__main__").main()
    assert os.umask(0o022) == 0o077
