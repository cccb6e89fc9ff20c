"""The product with an XMPP server and a robot over XMPP, with process failures."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from device_agent.protocol import JointTarget, JointTelemetry, Setpoint, codec, topics
from device_agent.protocol.security import setpoints
from tests.harness.browser.product import Api, Machine, enroll, mqtt_client, start_machine
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT

NUDGE = {"kind": "move_joints", "speed": 1.0}
LONG = {"kind": "move_joints", "speed": 0.05, "position_rad": {"shoulder_pan": 1.5}}
NAME = "remote"


class Agent:
    """``python -m device_agent`` with its own folder, as on another machine."""

    def __init__(self, machine: Machine, home: Path) -> None:
        self.home = home
        self._environment = os.environ | {"TELESCOPE_HOME": str(machine.home)}
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        log = (self.home / "log").open("ab")
        with log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "device_agent", "run", "--home", str(self.home)],
                cwd=ROOT,
                stdout=log,
                stderr=log,
                env=self._environment,
            )

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def kill(self) -> None:
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def stop(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._process.wait(20)


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    folder = tmp_path_factory.mktemp("machine")
    with start_machine(folder, TELESCOPE_XMPP="1", TELESCOPE_BROKER="mosquitto") as machine:
        assert machine.ready
        yield machine


@pytest.fixture(scope="module")
def api(machine: Machine) -> Iterator[Api]:
    with machine.api() as api:
        yield api


@pytest.fixture(scope="module")
def agent(machine: Machine, api: Api) -> Iterator[Agent]:
    agent = Agent(machine, machine.home / "agents" / NAME)
    enroll(machine, api, agent.home, f"{NAME}=ur5", "--transport", "xmpp")
    agent.start()
    yield agent
    agent.stop()


def nudge(api: Api, device: str, to_rad: float) -> dict[str, Any]:
    request = {**NUDGE, "position_rad": {"wrist_3": to_rad}}
    action: dict[str, Any] = api.post(
        f"/devices/{device}/actions", {"request": request, "wait_ms": 20_000, "wait_for": "done"}
    )
    return action


def test_an_action_from_start_to_end_over_xmpp(api: Api, agent: Agent) -> None:
    device = api.device(NAME)
    assert nudge(api, device["id"], 0.1)["status"] == "done", (agent.home / "log").read_text()
    (transport,) = {each["transport"] for each in api.get("/agents")["items"] if each["id"] in device["id"]}
    assert transport == "xmpp"


JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


def run_operator(machine: Machine, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """``examples/xmpp_operator.py`` in a session of its own."""
    link = machine.sign_in_link("demo").partition("#sign-in=")[2]
    answer = httpx.post(f"{machine.url}/api/v1/auth/sign-in", json={"link": link})
    token = answer.json()["access_token"]
    return subprocess.run(
        [sys.executable, str(ROOT / "examples" / "xmpp_operator.py"), *arguments],
        env=os.environ | {"TELESCOPE_URL": machine.url, "TELESCOPE_TOKEN": token},
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )


@pytest.mark.parametrize("name", [NAME, pytest.param("ur5", marks=pytest.mark.long)])
def test_an_xmpp_client_moves_six_joints_and_shows_them(machine: Machine, api: Api, agent: Agent, name: str) -> None:
    """Figures 4 and 6 of the UR5 paper, with a robot over XMPP and one over MQTT."""
    device = api.device(name)
    assert nudge(api, device["id"], 0.0)["status"] == "done", (agent.home / "log").read_text()
    with streaming(api, device) as (_, seen):
        start_rad = dict(zip(JOINTS, seen[-1].position_rad, strict=True))
    target_rad = {joint: angle_rad + 0.1 for joint, angle_rad in start_rad.items()}
    done = run_operator(machine, name, *(f"{joint}={angle}" for joint, angle in target_rad.items()))
    assert done.returncode == 0, done.stdout + done.stderr
    shown = dict(line.split() for line in done.stdout.partition("\n\n")[0].splitlines())
    assert {joint: float(shown[joint]) for joint in JOINTS} == pytest.approx(target_rad, abs=0.03)
    assert "rotation" in done.stdout


def test_an_xmpp_client_without_control_moves_nothing(machine: Machine, api: Api, agent: Agent) -> None:
    device = api.device(NAME)
    assert nudge(api, device["id"], 0.0)["status"] == "done", (agent.home / "log").read_text()
    with streaming(api, device) as (_, seen):  # another client has control
        done = run_operator(machine, NAME, "wrist_3=1.0")
        assert done.returncode == 1
        assert "409" in done.stderr, done.stderr
        assert max(abs(each.position_rad[5]) for each in seen) < 0.02


@pytest.mark.long
def test_a_console_moves_the_robot_and_receives_telemetry(api: Api, agent: Agent) -> None:
    del agent
    device = api.device(NAME)
    with streaming(api, device) as (setpoint, seen):
        start = seen[-1]
        target = start.position_rad[5] + 0.2
        for _ in range(60):
            setpoint(target)
            time.sleep(0.03)
        wait_until(lambda: abs(seen[-1].position_rad[5] - target) < 0.05, "the wrist to follow")
        assert seen[-1].loop_age_ms < 5000


@pytest.mark.long
@pytest.mark.parametrize("victim", ["infra.prosody", "function_app xmpp", "the agent"])
def test_an_action_ends_once_after_a_kill_and_the_next_one_runs(
    machine: Machine, api: Api, agent: Agent, victim: str
) -> None:
    device = api.device(NAME)["id"]
    action = api.post(f"/devices/{device}/actions", {"request": LONG, "wait_ms": 10_000, "wait_for": "started"})
    assert action["status"] == "started"
    if victim == "the agent":
        agent.kill()
        agent.start()
    else:
        machine.kill(victim)
    ended = api.get(f"/actions/{action['id']}", wait_ms=30_000, wait_for="done")
    assert ended["status"] == "failed", ended
    wait_until(lambda: next_done(api, device), "the next action")
    assert api.get(f"/actions/{action['id']}")["status"] == "failed"


def next_done(api: Api, device: str) -> bool:
    request = {**NUDGE, "position_rad": {"wrist_3": 0.05}}
    answer = api.http.post(
        f"/devices/{device}/actions", json={"request": request, "wait_ms": 20_000, "wait_for": "done"}
    )
    return answer.is_success and answer.json()["status"] == "done"


@pytest.mark.long
@pytest.mark.parametrize("who", ["the agent", "the gateway"])
def test_a_frozen_process_is_offline_within_ten_seconds(machine: Machine, api: Api, agent: Agent, who: str) -> None:
    api.device(NAME)
    pid = agent.pid if who == "the agent" else machine.pid("function_app xmpp")

    def offline() -> bool:
        if who == "the agent":
            return not next(each for each in api.get("/devices")["items"] if each["name"] == NAME)["online"]
        return (agent.home / "log").read_text().rstrip().endswith("link lost")

    os.kill(pid, signal.SIGSTOP)
    began_s = time.monotonic()
    try:
        wait_until(offline, "the agent to be offline")
        assert time.monotonic() - began_s < 10
    finally:
        os.kill(pid, signal.SIGCONT)
    wait_until(lambda: next_done(api, api.device(NAME)["id"]), "the next action")


@contextlib.contextmanager
def streaming(api: Api, device: dict[str, Any]) -> Iterator[tuple[Callable[[float], None], list[JointTelemetry]]]:
    """A console over MQTT with a lease: sends wrist setpoints and receives telemetry."""
    lease = api.post(f"/devices/{device['id']}/lease", {"wait_ms": 10_000})
    assert lease["confirmed"]
    credentials = {"purpose": "control", "device": device["id"], "epoch": lease["epoch"]}
    seen: list[JointTelemetry] = []
    number = 0
    with mqtt_client(api, purpose="view") as (watch, viewed), mqtt_client(api, **credentials) as (control, issued):
        (topic,) = issued["publish"]
        key = bytes.fromhex(lease["setpoint_key"])
        watched = [each for each in viewed["subscribe"] if each.split("/")[3] in device["id"] and "/tele/" in each]
        watch.paho.on_message = lambda _, __, message: seen.append(codec.decode(bytes(message.payload), JointTelemetry))
        assert all(topics.TELE in each for each in watched)
        watch.subscribe(*(each.replace("/tele/+", "/tele/joints") for each in watched), qos=0)
        wait_until(lambda: seen, "telemetry")

        def setpoint(target_rad: float) -> None:
            nonlocal number
            number += 1
            message = Setpoint(
                epoch=lease["epoch"],
                sequence=number,
                echo_tick_ms=seen[-1].tick_ms,
                sent_ms=time.monotonic() * 1000,
                target=JointTarget(position_rad={"wrist_3": target_rad}),
            )
            control.publish(topic, setpoints.seal(codec.encode(message), key, topic), qos=0)

        yield setpoint, seen
    api.http.delete(f"/devices/{device['id']}/lease", params={"epoch": lease["epoch"]})
