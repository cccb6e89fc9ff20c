"""Start and stop times of movement scripts.

``python -m benchmarks.agent.sandbox [RUNS]`` prints percentiles over 300 runs per kind [ms].

- *start*: from the request to the first message of the script, without and with a prepared process;
- *stop*: from the kill signal to the end of the process and the release of its memory.
"""

import contextlib
import json
import sys
import time

from benchmarks.reporting.report import percentile
from device_agent.ports.sandbox import Limits, SandboxProcess
from device_agent.sandbox.host import SandboxHost

_IGNORE_TERM = (
    "import signal\nfor n in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP): signal.signal(n, signal.SIG_IGN)\n"
)
_FILL_MEMORY = "blocks = []\ntry:\n    while True: blocks.append(bytearray(b'x' * 2**20))\nexcept MemoryError: pass\n"
_UNTIL_READY_S = 0.7
SCRIPTS = {
    "a script that waits": "print(1)\nwait(600)",
    "a script that imports NumPy": "import numpy\nprint(numpy.zeros(3))\nwait(600)",
    "a script that ignores SIGTERM and computes": f"{_IGNORE_TERM}print(1)\nwhile True: pass",
    "a script that has filled its memory": f"{_FILL_MEMORY}print(1)\nwhile True: pass",
}


def first_line(process: SandboxProcess, source: str) -> None:
    """Sends the script and waits for its first message."""
    with process.link.makefile("rwb") as lines:
        lines.readline()
        task = {"source": source, "name": "x", "parameters": {}, "joints": [], "frames": [], "can": []}
        lines.write(json.dumps(task).encode() + b"\n")
        lines.flush()
        if b"output" not in lines.readline():
            raise RuntimeError("the script did not print")


def measure(
    sandbox: SandboxHost, source: str, runs: int, *, untrusted: bool, pause_s: float = 0.0
) -> tuple[list[float], list[float]]:
    """Returns the start and stop time of each run [ms]."""
    starts, stops = [], []
    for _ in range(runs):
        time.sleep(pause_s)
        started_s = time.perf_counter()
        with contextlib.closing(sandbox.open(Limits(), untrusted=untrusted)) as process:
            first_line(process, source)
            starts.append((time.perf_counter() - started_s) * 1000)
            stopped_s = time.perf_counter()
            process.kill()
            if not process.wait(10):
                raise RuntimeError("the script did not end")
            stops.append((time.perf_counter() - stopped_s) * 1000)
    return starts, stops


def percentiles(values: list[float]) -> str:
    """Returns p50, p95, p99 and the maximum."""
    shares = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}
    return "   ".join(f"{name} {percentile(values, share):6.1f}" for name, share in shares.items())


def main(runs: int = 300) -> None:
    """Runs all measurements."""
    sandbox = SandboxHost()
    started_s = time.perf_counter()
    sandbox.start()
    print(f"warm parent ready after {(time.perf_counter() - started_s) * 1000:.0f} ms; {runs} runs each [ms]")
    for untrusted in (False, True):
        with contextlib.closing(sandbox.open(Limits(), untrusted=untrusted)):
            pass  # the first run starts the zygote
        prefix = "bubblewrap: " if untrusted else ""
        for name, source in SCRIPTS.items():
            starts, stops = measure(sandbox, source, runs, untrusted=untrusted)
            print(f"{prefix + name:58} start {percentiles(starts)}")
            print(f"{'':58} stop  {percentiles(stops)}")
        waits = SCRIPTS["a script that waits"]
        starts, _ = measure(sandbox, waits, max(1, runs // 6), untrusted=untrusted, pause_s=_UNTIL_READY_S)
        print(f"{prefix + 'a script that waits, in a prepared process':58} start {percentiles(starts)}")
    sandbox.close()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
