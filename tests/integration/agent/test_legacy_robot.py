"""The wrapper for legacy robots with the local cloud, under the oldest and a new Python."""

import os
import signal
import stat
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from device_agent.protocol import RunBehaviour
from device_agent.protocol.security import signing
from function_app.adapters.local.signing_keys import FileKeys
from function_app.adapters.shared.key_ring import Ring
from tests.harness.agent.legacy_robot import WRAPPER, LegacyRobot
from tests.harness.cloud.cloud import problem
from tests.harness.cloud.cloud_processes import CloudProcesses
from tests.harness.hosts.host import interpreter
from tests.harness.network.brokers import wait_until
from tests.harness.network.proxy import start_proxy

OLDEST, NEW = "3.6", "3.13"


@pytest.fixture
def processes(start_processes: Callable[[Any], CloudProcesses]) -> CloudProcesses:
    return start_processes("amqtt")


@pytest.fixture(params=[OLDEST, NEW])
def python(request: pytest.FixtureRequest) -> str:
    return interpreter(request.param)


@pytest.fixture
def robot(processes: CloudProcesses, python: str, tmp_path: Path) -> Iterator[LegacyRobot]:
    with LegacyRobot(processes, python, tmp_path) as robot:
        yield robot.pair()


def test_movements_of_the_folder_run_and_report_their_output(robot: LegacyRobot) -> None:
    robot.run("--report-every", "0.1")
    wave = robot.begin("wave", wait_ms=30_000, wait_for="done")
    assert wave["status"] == "done", (wave, robot.log())
    assert wave["output"].startswith("waves {}"), wave
    assert wave["result"]["duration_s"] > 0
    trip = robot.end(robot.begin("trip")["id"])
    assert (trip["status"], trip["reason"]["code"], trip["output"]) == ("failed", "script_failed", "falls\n"), trip
    assert "code 3" in trip["reason"]["message"]
    said = robot.anna.start(robot.device, request={"kind": "say", "text": "Ahoj"}, wait_ms=30_000, wait_for="done")
    assert (said.json()["status"], said.json()["output"]) == ("done", "Ahoj\n"), said.text
    unknown = robot.anna.start(robot.device, request={"kind": "run_behaviour", "name": "_helper"})
    assert problem(unknown, 422, "unable")["names"] == ["stubborn", "trip", "walk", "wave"]
    wait_until(lambda: robot.anna.get(f"/devices/{robot.device}/latency").json()["items"], "response times")
    paths = {item["path"] for item in robot.anna.get(f"/devices/{robot.device}/latency").json()["items"]}
    assert "device-cloud" in paths
    assert robot.terminate() == 0
    wait_until(lambda: not robot.anna.get(f"/devices/{robot.device}").json()["online"], "the robot to be offline")


def test_a_cancel_ends_all_processes_of_a_movement(robot: LegacyRobot) -> None:
    robot.run()
    for name in ("walk", "stubborn"):
        action = robot.begin_walk(name)
        assert robot.walking()
        assert robot.anna.post(f"/actions/{action}/cancel").status_code in {200, 202}
        assert robot.end(action)["status"] == "cancelled"
        assert robot.walking() == []


def test_the_wrapper_ends_a_movement_at_its_time_limit(robot: LegacyRobot) -> None:
    robot.run("--max-duration", "0.5")
    ended = robot.end(robot.begin("walk")["id"])
    assert (ended["status"], ended["reason"]["code"]) == ("failed", "too_long")
    assert robot.walking() == []


def test_stop_ends_the_movement_and_latches_until_the_reset(robot: LegacyRobot) -> None:
    robot.run()
    action = robot.begin_walk()
    stop = robot.anna.post(f"/devices/{robot.device}/stop", {"reason": "test"})
    assert stop.status_code in {200, 202}
    assert robot.end(action)["reason"]["code"] == "stopped"
    assert robot.walking() == []
    wait_until(lambda: robot.state()["mode"] == "stopped", "the latch")
    assert robot.state()["stop"]["caller"] == "anna"
    assert robot.terminate() == 0

    robot.run()
    assert robot.end(robot.begin("wave")["id"])["reason"]["code"] == "stopped", "the latch survives a restart"
    assert robot.anna.post(f"/devices/{robot.device}/stop/reset").status_code in {200, 202}
    wait_until(lambda: robot.state()["mode"] == "idle", "the reset")
    assert robot.end(robot.begin("wave")["id"])["status"] == "done"
    assert [len(robot.events(kind)) for kind in ("stop-latched", "stop-reset")] == [1, 1]


def test_a_stop_of_an_idle_robot_is_confirmed(robot: LegacyRobot) -> None:
    robot.run()
    stop = robot.anna.post(f"/devices/{robot.device}/stop", {"reason": "test"})
    wait_until(lambda: robot.state()["mode"] == "stopped", "the latch")
    assert stop.json()["outcome"] in {"confirmed", "sent"}, stop.text


def test_a_movement_ends_with_a_killed_wrapper_and_never_runs_again(robot: LegacyRobot) -> None:
    robot.run()
    action = robot.begin_walk("stubborn")
    robot.kill()
    wait_until(lambda: not robot.walking(), "the end of the movement")
    walks = robot.walks()

    robot.run()
    ended = robot.end(action)
    assert (ended["status"], ended["reason"]["code"]) == ("failed", "agent_restarted")
    assert robot.end(robot.begin("wave")["id"])["status"] == "done"
    assert robot.walks() == walks


@pytest.mark.parametrize("offset_s", [3600, -3600])
def test_a_wrong_clock_of_the_robot_changes_nothing(robot: LegacyRobot, offset_s: int) -> None:
    robot.clock_offset_s = offset_s
    robot.run("--report-every", "0.1")
    assert robot.end(robot.begin("wave")["id"])["status"] == "done", robot.log()
    now_ms = robot.processes.cloud.clock.now_ms()
    walk = RunBehaviour(name="walk")
    robot.deliver(robot.command(walk, id="expired-1", issued_at_ms=now_ms - 60_000))
    wait_until(lambda: robot.last_ack("expired-1") == ("expired", "expired"), "the expired command")
    robot.deliver(robot.command(walk, id="future-1", issued_at_ms=now_ms + 600_000))
    wait_until(lambda: robot.last_ack("future-1") == ("failed", "from_the_future"), "the command of the future")
    assert robot.walks() == []
    wait_until(lambda: robot.anna.get(f"/devices/{robot.device}/latency").json()["items"], "response times")

    action = robot.begin_walk()
    robot.kill()
    wait_until(lambda: not robot.walking(), "the end of the movement")
    walks = robot.walks()
    robot.clock_offset_s = -offset_s  # a robot without a clock of its own starts with another time
    robot.run("--lost-after", "1")
    assert robot.end(action)["reason"]["code"] == "agent_restarted"
    assert robot.end(robot.begin("wave")["id"])["status"] == "done", robot.log()
    assert robot.walks() == walks

    action = robot.begin_walk()
    server = robot.processes.endpoints["server"]
    server.kill()
    wait_until(lambda: not robot.walking(), "the end of the movement")
    server.revive()
    assert robot.end(action)["reason"]["code"] == "link_lost"


def test_a_movement_whose_guard_is_killed_has_failed(robot: LegacyRobot) -> None:
    robot.run()
    action = robot.begin_walk()
    (process,) = robot.walks()
    os.kill(parent(process), signal.SIGKILL)
    ended = robot.end(action)
    assert (ended["status"], ended["reason"]["code"]) == ("failed", "script_failed")
    assert robot.walking() == []


def test_the_wrapper_does_not_start_while_a_movement_of_an_earlier_run_exists(robot: LegacyRobot) -> None:
    robot.run()
    action = robot.begin_walk()
    (process,) = robot.walks()
    guard = parent(process)
    os.kill(guard, signal.SIGSTOP)
    robot.kill()
    refused = robot.call("run", "--movements", str(robot.movements), "--home", str(robot.home))
    assert refused[0] == 1
    assert "in use" in refused[1], refused
    assert robot.walking() == [process]
    os.kill(guard, signal.SIGCONT)
    robot.run()
    assert robot.walking() == []
    assert robot.end(action)["reason"]["code"] == "agent_restarted"


def parent(process: int) -> int:
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])


def test_a_movement_ends_when_the_connection_is_lost(robot: LegacyRobot) -> None:
    robot.run("--lost-after", "1")
    action = robot.begin_walk()
    server = robot.processes.endpoints["server"]
    server.kill()
    wait_until(lambda: not robot.walking(), "the end of the movement")
    server.revive()
    ended = robot.end(action)
    assert (ended["status"], ended["reason"]["code"]) == ("failed", "link_lost"), ended
    assert robot.end(robot.begin("wave")["id"])["status"] == "done"
    assert len(robot.walks()) == 1


def test_a_silent_connection_is_lost_too(robot: LegacyRobot) -> None:
    with start_proxy(robot.processes.endpoints["server"].port) as proxy:
        robot.redirect(f"http://127.0.0.1:{proxy.port}")
        robot.run("--lost-after", "1")
        action = robot.begin_walk()
        proxy.freeze()
        wait_until(lambda: not robot.walking(), "the end of the movement")
        proxy.thaw()
        assert robot.end(action)["reason"]["code"] == "link_lost"


def test_only_fresh_commands_with_a_pinned_key_run_and_only_once(robot: LegacyRobot) -> None:
    robot.run()
    walk = RunBehaviour(name="walk")
    now_ms = robot.processes.cloud.clock.now_ms()

    robot.deliver(robot.command(walk, key=signing.generate()))
    valid = robot.command(walk)
    robot.deliver(valid.replace(b'"walk"', b'"wave"'))
    robot.deliver(b'{"key": "x"}')
    robot.deliver(robot.command(walk, agent="other"))
    wait_until(lambda: robot.rejected("bad_signature"), "the forged command")
    wait_until(lambda: robot.rejected("malformed"), "the malformed command")
    wait_until(lambda: robot.rejected("wrong_address"), "the command of another robot")

    robot.deliver(robot.command(walk, id="expired-1", issued_at_ms=now_ms - 60_000))
    wait_until(lambda: robot.last_ack("expired-1") == ("expired", "expired"), "the expired command")
    robot.deliver(robot.command(walk, id="future-1", issued_at_ms=now_ms + 600_000))
    wait_until(lambda: robot.last_ack("future-1") == ("failed", "from_the_future"), "the command of the future")

    robot.deliver(robot.command(RunBehaviour(name="wave"), id="first-1", epoch=1000))
    wait_until(lambda: robot.last_ack("first-1") == ("done", ""), "the valid command")
    robot.deliver(robot.command(walk, id="stale-1", epoch=999))
    wait_until(lambda: robot.last_ack("stale-1") == ("failed", "stale_epoch"), "the command of an older lease")
    assert robot.walks() == []

    ended = robot.command(RunBehaviour(name="step"), id="once-1", epoch=1000)
    (robot.movements / "step").write_text("#!/bin/sh\necho $$ >> walks\n")
    (robot.movements / "step").chmod(0o755)
    assert robot.terminate() == 0
    robot.run()
    assert robot.last_ack("first-1") == ("done", "")
    robot.deliver(ended)
    wait_until(lambda: robot.last_ack("once-1") == ("failed", "lease_ended"), "a restart ends the lease")
    once = robot.new_id()
    again = robot.command(RunBehaviour(name="step"), id=once, epoch=1001)
    for _ in range(2):
        robot.deliver(again, once)
        wait_until(lambda: not robot.is_waiting(once), "the answer")
        wait_until(lambda: robot.last_ack(once) == ("done", ""), "the end of the command")
    assert robot.terminate() == 0
    robot.run()
    robot.deliver(again, once)
    wait_until(lambda: not robot.is_waiting(once), "the answer")
    assert robot.last_ack(once) == ("done", "")
    assert len(robot.walks()) == 1


def test_a_lease_that_ends_stops_its_movement(robot: LegacyRobot) -> None:
    robot.run()
    epoch = robot.anna.take_lease(robot.device).json()["epoch"]
    action = robot.begin_walk(epoch=epoch)
    wait_until(lambda: (robot.state()["lease"] or {}).get("holder") == "anna", "the lease in the state")
    assert robot.anna.delete(f"/devices/{robot.device}/lease?epoch={epoch}").is_success
    assert robot.end(action)["reason"]["code"] == "lease_lost"
    assert robot.walking() == []


def test_the_wrapper_follows_a_rotation_of_the_keys(robot: LegacyRobot) -> None:
    robot.run()
    keys = FileKeys(robot.processes.home / "keys")
    old = keys.load()
    robot.processes.cloud.run(robot.processes.cloud.functions.keys.rotate(learn_ms=3_600_000, overlap_ms=7_200_000))
    assert robot.terminate() == 0
    robot.run()
    ring = keys._parse()
    keys._write(Ring((*ring.keys[:-1], replace(ring.newest, devices_from_ms=0))))
    new = robot.processes.cloud.run(robot.processes.cloud.functions.keys.for_devices())
    assert signing.key_id(new.public_key()) != signing.key_id(old.public_key())
    assert robot.end(robot.begin("wave")["id"])["status"] == "done", robot.log()


def test_functions_of_a_program_run_as_actions(robot: LegacyRobot, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "import sys, telescope_legacy\n"
        "robot = telescope_legacy.Robot(sys.argv[1])\n"
        "def count(action):\n"
        "    action.print('counts')\n"
        "    action.ended.wait()\n"
        "def say(action):\n"
        "    return {'length': len(action.parameters['text'])}\n"
        "def stumble(action):\n"
        "    raise ValueError('falls')\n"
        "robot.on('count', count).on('say', say).on('stumble', stumble).run()\n"
    )
    robot.start(str(robot.home), program=program)
    wait_until(lambda: robot.anna.get(f"/devices/{robot.device}").json()["online"], "the connection")
    said = robot.anna.start(robot.device, request={"kind": "say", "text": "Ahoj"}, wait_ms=30_000, wait_for="done")
    assert said.json()["result"]["length"] == 4, said.text
    assert robot.end(robot.begin("stumble")["id"])["reason"]["message"] == "falls"
    action = robot.begin("count", wait_ms=30_000)["id"]
    assert robot.anna.post(f"/actions/{action}/cancel").status_code in {200, 202}
    ended = robot.end(action)
    assert (ended["status"], ended["output"]) == ("cancelled", "counts")


def test_files_with_secrets_are_private_and_one_run_is_possible(robot: LegacyRobot) -> None:
    robot.run()
    modes = {file.name: stat.S_IMODE(file.stat().st_mode) for file in robot.home.iterdir()}
    assert modes["agent.json"] == modes["journal.jsonl"] == 0o600
    assert stat.S_IMODE(robot.home.stat().st_mode) == 0o700
    second = robot.call("run", "--movements", str(robot.movements), "--home", str(robot.home))
    assert second == (1, f"error: {robot.home} is in use: the wrapper, or a script of an earlier run, still runs\n")


def test_errors_state_the_cause_without_a_traceback(robot: LegacyRobot, tmp_path: Path) -> None:
    home = ["--home", str(tmp_path / "other")]
    movements = ["--movements", str(robot.movements)]
    unreachable = robot.call("enroll", "--url", "http://127.0.0.1:9", "--name", "qbo", *home)
    assert unreachable[0] == 1
    assert unreachable[1].startswith("error: the enrolment failed: "), unreachable
    unpaired = robot.call("run", *movements, *home)
    assert unpaired == (1, "error: this robot is not paired; run `enroll` first\n")
    absent = robot.call("run", *movements, "--home", str(tmp_path / "none"))
    assert absent == (1, f"error: {tmp_path / 'none'} holds no robot; run `enroll` first\n")
    named = robot.call("enroll", "--url", robot.url, "--name", "two words", "--home", str(tmp_path / "none"))
    assert named == (1, "error: 'two words' is not a name: use letters, digits, _ and -\n")
    (robot.movements / "walk.py").chmod(0o666)
    writable = robot.call("run", *movements, "--home", str(robot.home))
    assert writable[0] == 1
    assert "walk.py can be changed by every user" in writable[1]
    assert robot.call("--help")[0] == 0
    assert robot.call()[0] == 2

    (robot.movements / "walk.py").chmod(0o644)
    robot.run()
    assert robot.anna.delete(f"/agents/{robot.agent}").status_code == 204
    wait_until(lambda: robot.exit_code() is not None, "the end of the wrapper")
    assert robot.exit_code() == 1
    assert "error: this robot was unpaired; run `enroll` again" in robot.log()


def test_a_damaged_journal_stops_the_wrapper_but_an_incomplete_last_line_does_not(robot: LegacyRobot) -> None:
    robot.run()
    assert robot.end(robot.begin("wave")["id"])["status"] == "done"
    assert robot.terminate() == 0
    journal = robot.home / "journal.jsonl"
    with journal.open("a") as file:
        file.write('{"epoch": 9')
    robot.run()
    assert robot.terminate() == 0
    journal.write_text("{}\nnonsense\n{}\n")
    damaged = robot.call("run", "--movements", str(robot.movements), "--home", str(robot.home))
    assert damaged[0] == 1
    assert damaged[1].startswith(f"error: line 2 of {journal} is damaged"), damaged


def test_the_file_imports_only_the_standard_library(python: str) -> None:
    check = subprocess.run([python, "-I", "-S", str(WRAPPER), "--help"], capture_output=True, text=True, check=False)
    assert (check.returncode, check.stderr) == (0, "")
