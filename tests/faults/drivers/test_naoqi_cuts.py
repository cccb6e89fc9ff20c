"""A NAO that walks and moves its joints is at rest 350 ms after its agent ends or hangs."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest

from device_agent.drivers.naoqi.driver import NaoqiDriver
from device_agent.ports.driver import Twist
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import NAOQI_PYTHON, ROBOTS, ROOT
from tests.harness.robots.naoqi.peer import NaoPeer

NAO = robot_type.load(ROBOTS / "nao")
LIMIT_S = 0.35
WALK = Twist(forward_m_s=0.05, turn_rad_s=0.1)
PERIOD_S = 0.02
AGENT = """
import json, sys, time
from device_agent.ports.driver import Twist
from tests.faults.drivers.test_naoqi_cuts import make_driver, start_motion
driver = make_driver(json.loads(sys.argv[1]))
driver.connect()
start_motion(driver, lambda: False)
"""
"""An agent that moves the robot until it is killed."""


def make_driver(options: dict[str, str]) -> NaoqiDriver:
    return NaoqiDriver(NAO, ROBOTS / "nao", url=f"tcp://{options['address']}", python=options["python"], device="nao")


def start_motion(driver: NaoqiDriver, moves: Callable[[], bool]) -> None:
    """Command as the agent does until the robot moves. The head has a far target, so that only a hold stops it."""
    target = list(driver.observe().position_rad)
    target[0] = 2.0 if target[0] < 0 else -2.0
    while not moves():
        driver.send(target)
        driver.drive(WALK)
        time.sleep(PERIOD_S)


@pytest.fixture
def peer() -> Iterator[NaoPeer]:
    peer = NaoPeer(NAO, NAOQI_PYTHON)
    yield peer
    peer.close()


def moves(peer: NaoPeer) -> bool:
    state = peer.state()
    return any(state["twist"]) and abs(state["velocity"]["HeadYaw"]) > 1.0


def rest_s(peer: NaoPeer, cut_s: float) -> float:
    """Time from a cut to the robot's rest, on the peer's clock, which is that of this machine."""
    while True:
        state = peer.state()
        if state["rest_s"] is not None and state["rest_s"] >= cut_s:
            break
        assert time.monotonic() - cut_s < 20, "the robot continues to move"
        time.sleep(0.01)
    assert abs(state["position"]["HeadYaw"]) < 1.99, "it has gone to its target"
    return float(state["rest_s"] - cut_s)


def cut(driver: NaoqiDriver, kind: str) -> float:
    """End the commands; returns when."""
    cut_s = time.monotonic()
    if kind == "agent ends":
        driver._connection._bridge.disconnect()  # type: ignore[union-attr] # as the kernel does for a process that ends
    elif kind == "stop":
        driver.halt()
    return cut_s


@pytest.mark.parametrize("count", [6, pytest.param(200, marks=[pytest.mark.long, pytest.mark.timeout(1800)])])
def test_a_nao_rests_in_time_after_each_cut(peer: NaoPeer, count: int) -> None:
    choice = random.Random(3)
    driver = make_driver(peer.options())
    times: dict[str, list[float]] = {"agent ends": [], "agent hangs": [], "stop": []}
    try:
        for index in range(count):
            kind = list(times)[index % len(times)]
            driver.connect()
            start_motion(driver, lambda: moves(peer))
            time.sleep(choice.uniform(0, PERIOD_S))
            times[kind].append(rest_s(peer, cut(driver, kind)))
    finally:
        driver.close()
        for kind, values in times.items():
            print(kind, len(values), "cuts; rest after", *(f"{1000 * value:.0f}" for value in sorted(values)), "ms")
    assert max(max(values) for values in times.values()) <= LIMIT_S


def test_a_nao_rests_in_time_after_its_agent_was_killed(peer: NaoPeer) -> None:

    agent = subprocess.Popen([sys.executable, "-c", AGENT, json.dumps(peer.options())], cwd=ROOT)
    try:
        while not moves(peer):
            assert agent.poll() is None
            time.sleep(0.01)
        bridge = subprocess.check_output(["pgrep", "-P", str(agent.pid), "-f", "naoqi/bridge.py"], text=True)
        os.kill(int(bridge), signal.SIGTERM)  # a service manager may end all processes of the agent
        cut_s = time.monotonic()
        agent.send_signal(signal.SIGKILL)
        assert rest_s(peer, cut_s) <= LIMIT_S
    finally:
        agent.kill()
        agent.wait()
