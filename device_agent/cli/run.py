"""``run``: run the agent."""

import argparse
import contextlib
import ctypes
import gc
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from device_agent import bootstrap
from device_agent.cli import robot_types, systemd
from device_agent.cli.arguments import Commands, add_home, add_no_qr
from device_agent.cli.enroll import announce, await_claim
from device_agent.cli.local_control.server import ControlServer
from device_agent.cli.releases.trial import PASSED, SUSPENDED, Trial
from device_agent.config.agent_config import AgentConfig
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore
from device_agent.config.release import VERSION
from device_agent.ports.clock import CloudClock
from device_agent.ports.sensor import SensorError
from device_agent.ports.tracing import CommandTraces, NoTraces
from device_agent.runtime.restart_permission import RestartPermission
from device_agent.runtime.supervision import CHECK_PERIOD_S

if TYPE_CHECKING:
    from device_agent.transports.metrics import AgentMetrics

EXIT_FAILED = 70
"""Exit code after an essential thread has ended or hung, so that the service manager restarts the agent."""
_STOP_S = 10.0
"""Time for an orderly end after such a failure [s]."""
_WATCHDOG_S, _STARTING_WATCHDOG_S = 10.0, 60.0
"""Timeout of systemd's watchdog while the agent runs, and otherwise [s]; the latter is that of the unit."""
_NOTIFY_S = 0.5
_RETRY_S = 5.0
_SWITCH_INTERVAL_S = 0.001
_M_ARENA_MAX, _HEAPS = -8, 2
_M_MMAP_THRESHOLD, _LARGE_BYTES = -3, 256 * 1024
"""Parameters of ``mallopt`` in ``malloc.h``, and their values."""
_log = logging.getLogger(__name__)


def add_commands(commands: Commands, home: Path) -> None:
    """Add ``run``."""
    parser = commands.add_parser("run", help="run the agent until Ctrl-C or SIGTERM")
    parser.add_argument(
        "--trace", type=Path, metavar="FOLDER", help="folder in which simulated devices record their ground truth"
    )
    parser.add_argument("--metrics", type=int, metavar="PORT", help="serve metrics at this port of 127.0.0.1")
    add_no_qr(parser)
    add_home(parser, home)
    parser.set_defaults(command=_run)


def _run(options: argparse.Namespace) -> int:
    _configure_allocator()
    store = IdentityStore(options.home)
    with store.lock():
        trial = Trial.of(store.folder, os.environ)
        if trial is not None:
            trial.start()
        if store.pairing() is None:
            if trial is not None:
                trial.finish(PASSED)  # without a pairing there is nothing else to prove
            _pair(store, qr=not options.no_qr)
        if options.trace is not None:
            options.trace.mkdir(parents=True, exist_ok=True)
        robot_types.update(store)
        metrics = None if options.metrics is None else _serve_metrics(options.metrics)
        traces = _export_traces(os.environ)
        while (code := _run_until_unpaired(store, options.trace, metrics, traces, trial)) is None:
            _pair(store, qr=not options.no_qr)
            robot_types.update(store)
        traces.close()
    return code


def _pair(store: IdentityStore, *, qr: bool) -> None:
    """Load the pairing from the cloud. If there is none, show a claim code and wait for the claim.

    Retries while the cloud cannot be reached: a robot may boot before its network.
    """
    config = AgentConfig.load(store.folder)
    systemd.ready("waiting to be claimed")
    previous = signal.signal(signal.SIGTERM, _exit)
    control = ControlServer(
        store.folder,
        RestartPermission(_NoDevices()),
        linked=lambda: False,
        restart=lambda: os.kill(os.getpid(), signal.SIGTERM),
    )
    control.start()
    try:
        while True:
            api = bootstrap.cloud_client(store, config, CloudClock())
            try:
                await_claim(store, api, config, announce(api, config, qr=qr), qr=qr)
            except OSError as error:
                print(f"telescope agent: {error}; trying again in {_RETRY_S:.0f} s", file=sys.stderr, flush=True)
                time.sleep(_RETRY_S)
            else:
                return
    finally:
        control.stop()
        signal.signal(signal.SIGTERM, previous)


class _NoDevices:
    """An agent that waits to be claimed: nothing can move."""

    def suspend(self, _why: str) -> str:
        return ""

    def resume(self) -> None:
        return


def _exit(*_: object) -> None:
    """Exit immediately: no device is running yet."""
    raise SystemExit(0)


def _serve_metrics(port: int) -> "AgentMetrics":
    """Start to serve metrics.

    Raises:
        ConfigError: The package is missing, or the port is in use.
    """
    try:
        from device_agent.transports.metrics import AgentMetrics  # noqa: PLC0415 (optional)

        return AgentMetrics.serve(port)
    except ModuleNotFoundError as error:
        raise ConfigError(f"--metrics needs the Python package {error.name}") from error
    except OSError as error:
        raise ConfigError(f"--metrics {port}: {error.strerror}; choose a free port") from error


def _export_traces(environment: Mapping[str, str]) -> CommandTraces:
    """The traces of this agent; none without a receiver or without the packages."""
    if not any(environment.get(f"OTEL_EXPORTER_OTLP_{name}") for name in ("ENDPOINT", "TRACES_ENDPOINT")):
        return NoTraces()
    try:
        from device_agent.transports.tracing import OtlpTraces  # noqa: PLC0415 (optional)
    except ModuleNotFoundError as error:
        _log.warning("no traces: install telescope-agent[tracing]; the Python package %s is missing", error.name)
        return NoTraces()
    return OtlpTraces()


def _run_until_unpaired(
    store: IdentityStore, trace: Path | None, metrics: "AgentMetrics | None", traces: CommandTraces, trial: Trial | None
) -> int | None:
    """Run with the saved pairing. Returns the exit code, or ``None`` if the pairing is no longer valid."""
    stop = threading.Event()
    previous = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    agent = bootstrap.build(store, trace=trace, metrics=metrics, traces=traces)
    permission = RestartPermission(agent.agent)
    control = ControlServer(store.folder, permission, linked=lambda: agent.agent.linked, restart=stop.set)
    try:
        on_trial = trial is not None and not trial.over
        if on_trial:
            agent.agent.suspend(SUSPENDED)
        if renderer := _renderer_name(AgentConfig.load(store.folder)):
            print(f"renderer {renderer}", flush=True)
        agent.start()
        _prioritize_control_loops()
        print("running", flush=True)
        systemd.ready("running")
        systemd.set_watchdog(_WATCHDOG_S)
        if trial is not None and on_trial:
            return _supervise(agent, stop, partial(_check_trial, trial, agent, control))
        control.start()
        return _supervise(agent, stop)
    finally:
        systemd.set_watchdog(_STARTING_WATCHDOG_S)
        agent.stop()
        control.stop()
        for number, handler in previous.items():
            signal.signal(number, handler)


def _check_trial(trial: Trial, agent: bootstrap.RunningAgent, control: ControlServer) -> None:
    """Allow motion, and restarts, once a new release has proved that it works."""
    if trial.check(healthy=agent.supervisor.healthy, linked=agent.agent.linked, now_s=time.monotonic()):
        agent.agent.resume()
        control.start()
        print(f"release {VERSION} has passed its check", flush=True)


def _supervise(
    agent: bootstrap.RunningAgent, stop: threading.Event, on_check: Callable[[], None] = lambda: None
) -> int | None:
    """Check the agent's threads until it ends; see ``_run_until_unpaired``. ``on_check`` runs after each check."""
    notified_s = 0.0
    while not stop.wait(CHECK_PERIOD_S):
        if reason := agent.supervisor.check():
            print(f"telescope agent: {reason}", file=sys.stderr, flush=True)
            _force_exit_later()
            return EXIT_FAILED
        if agent.supervisor.healthy and time.monotonic() - notified_s >= _NOTIFY_S:
            notified_s = time.monotonic()
            systemd.notify_watchdog()
        on_check()
        if agent.outdated:
            return None
    return 0


def _force_exit_later() -> None:
    """End the process even if the failed thread blocks its orderly end."""
    timer = threading.Timer(_STOP_S, os._exit, (EXIT_FAILED,))
    timer.daemon = True
    timer.start()


def _configure_allocator() -> None:
    """Use two heaps for all threads, and return the memory of large blocks as soon as they are free.

    The GNU C library makes up to eight for each processor, and free memory of one cannot be used by the threads of
    another. The agent of five devices has seventy threads. The library also takes large blocks, such as pictures, from
    a heap once it has freed a larger one, and keeps their memory: in the laboratory 155 MB instead of 149.
    """
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library
            library = ctypes.CDLL(None)
            library.mallopt(_M_ARENA_MAX, _HEAPS)
            library.mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)


def _prioritize_control_loops() -> None:
    """Bound the time for which other threads can delay a control loop; see docs/results/measured.md.

    A computing thread yields after 1 ms instead of 5 ms. The garbage collector ignores the objects made so far: a full
    collection of them paused all threads for 40 ms.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()


def _renderer_name(configuration: AgentConfig) -> str:
    """Name of the library that renders simulated cameras, or why there is none; empty without simulated devices."""
    if not bootstrap.simulates(configuration):
        return ""
    from device_agent.simulation import offscreen  # noqa: PLC0415 (real devices need no simulation)

    try:
        return offscreen.select().name
    except SensorError as error:
        return f"none: {error}"
