import subprocess
import sys

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
(port,) = programs.free_ports("127.0.0.1", 0)
command = [sys.executable, "-c", server, str(port)]
sys.exit(programs.supervise("server", command, host="127.0.0.1", ports=(port,), ready="ready"))
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
