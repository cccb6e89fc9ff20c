"""The simulated world: time, commands, snapshots, trace, faults."""

import json
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from device_agent.drivers.mujoco import Placement, World
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests import robot_type
from device_agent.simulation.scene_assembly import TIMESTEP_S
from device_agent.simulation.world import LATE_STEPS, MAX_CATCH_UP_S
from tests.harness.paths import UR5

pytestmark = pytest.mark.slow
HOME = robot_type.load(UR5).home_rad
ALL = np.arange(6)


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "not within 60 s"
        time.sleep(0.002)


def ur5_world(trace: Path | None = None) -> World:
    return World(UR5 / "scene.xml", home=HOME, trace=trace)


@pytest.fixture
def unbuilt() -> World:
    return ur5_world()


@pytest.fixture
def world() -> World:
    world = ur5_world()
    world.build()
    return world


def test_snapshots_are_immutable_and_consistent(world: World):
    home = world.step(500)
    assert home.position_rad == pytest.approx(HOME, abs=1e-4)
    before = home.qpos.copy()
    world.command("arm", ALL, [0.5, -1.2, 1.2, -1.0, -1.0, 0.5])
    snapshot = world.step(37)
    assert np.array_equal(home.qpos, before)
    with pytest.raises(ValueError, match="read-only"):
        home.qpos[0] = 1.0
    data = mujoco.MjData(world.model)
    data.qpos[:] = snapshot.qpos
    mujoco.mj_kinematics(world.model, data)
    assert np.abs(data.site_xpos - snapshot.site_position_m).max() < 1e-12
    assert np.abs(data.xpos - snapshot.body_position_m).max() < 1e-12


def test_the_newest_command_is_followed_linearly(world: World):
    start = world.snapshot().ctrl
    world.command("arm", ALL, start + 0.06, ramp_s=0.012)
    steps = [float(world.step(1).ctrl[0] - start[0]) for _ in range(8)]
    assert steps == pytest.approx([0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.06, 0.06])
    world.command("arm", ALL, start - 1.0, ramp_s=0.012)
    target = start + 0.03
    world.command("arm", ALL, target, ramp_s=0.012)
    target[:] = 3.0  # the command is a copy
    assert np.abs(world.step(6).ctrl - (start + 0.03)).max() < 1e-12


@pytest.mark.parametrize("counted", ['actuatorgravcomp="true"', ""])
def test_effort_includes_gravity_compensation(tmp_path: Path, counted: str):
    model = (UR5 / "ur5.xml").read_text().replace('actuatorgravcomp="true"', counted)
    (tmp_path / "arm.xml").write_text(model)
    world = World(tmp_path / "arm.xml", home=HOME)
    world.build()
    effort = world.step(10).effort
    assert abs(effort[1]) > 10  # gravity load of the arm
    assert abs(effort[0]) < 0.1  # vertical axis, no gravity load


def test_real_time_runs_while_there_are_users_and_resumes_where_it_stopped(unbuilt: World):
    before_s = time.monotonic()
    unbuilt.open()
    unbuilt.open()
    try:
        until(lambda: unbuilt.snapshot().time_s > 0.2)
        snapshot = unbuilt.snapshot()
        assert snapshot.time_s <= snapshot.taken_s - before_s + 0.005, "simulated time runs ahead of the clock"
        with pytest.raises(DriverError, match="real time"):
            unbuilt.step(1)
        unbuilt.close()
        before = unbuilt.snapshot().time_s
        until(lambda: unbuilt.snapshot().time_s > before)
    finally:
        unbuilt.close()
    stopped = unbuilt.snapshot().time_s
    assert "mujoco-world" not in [thread.name for thread in threading.enumerate()]
    unbuilt.open()
    assert unbuilt.snapshot().time_s >= stopped
    until(lambda: unbuilt.snapshot().time_s > stopped)
    unbuilt.close()


def test_lost_time_is_reported(unbuilt: World, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    groups = 0
    advance = unbuilt._advance

    def pause_once(count: int) -> None:
        nonlocal groups
        groups += 1
        if groups == 5:
            time.sleep(MAX_CATCH_UP_S * 10)
        advance(count)

    monkeypatch.setattr(unbuilt, "_advance", pause_once)
    before_s = time.monotonic()
    unbuilt.open()
    try:
        until(lambda: unbuilt.snapshot().time_s > 0.3)
        snapshot = unbuilt.snapshot()
    finally:
        unbuilt.close()
    lost_s = snapshot.lag_ms / 1000
    assert lost_s >= MAX_CATCH_UP_S * 9
    assert "cannot keep up" in caplog.text
    assert snapshot.time_s + lost_s <= snapshot.taken_s - before_s + 0.005, "lost time is caught up in a burst"


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_diverged_world_stops_with_a_fault(world: World, value: float):
    world.step(100)
    world._data.qvel[0] = value
    with pytest.raises(DriverError, match="unstable"):
        world.step(2)
    assert "unstable" in world.snapshot().fault
    assert world.snapshot().time_s > 0.1, "it must not be reset to the start"


def test_an_error_while_stepping_becomes_a_fault(unbuilt: World, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(unbuilt, "_advance", lambda _: 1 / 0)
    unbuilt.open()
    try:
        until(lambda: "division by zero" in unbuilt.snapshot().fault)
    finally:
        unbuilt.close()


def test_the_trace_has_the_state_at_100_hz(tmp_path: Path):
    path = tmp_path / "trace.ndjson"
    path.write_text("earlier\n")
    world = ur5_world(path)
    world.open()
    try:
        world.command("arm", ALL, [0.2, -1.5, 1.5, -1.5, -1.5, 0.1], ramp_s=0.5)
        until(lambda: world.snapshot().time_s > 0.3)
    finally:
        world.close()
    earlier, *lines = path.read_text().splitlines()
    assert earlier == "earlier", "the trace is appended"
    header, *rows = map(json.loads, lines)
    assert header == {"joints": list(HOME), "actuators": list(HOME)}
    assert len(rows) > 20
    times = np.array([row["time_s"] for row in rows])
    # A line is written after a group of steps; a world that is late makes larger ones.
    assert np.diff(times) == pytest.approx(0.01, abs=LATE_STEPS * TIMESTEP_S + 1e-4)
    assert np.mean(np.diff(times)) == pytest.approx(0.01, abs=0.0025)
    ticks = [row["tick_ms"] for row in rows]
    assert ticks == sorted(ticks)
    assert abs(rows[-1]["at_ms"] / 1000 - time.time()) < 60
    for row in rows:
        assert {len(row[name]) for name in ("qpos", "qvel", "target", "ctrl")} == {6}
    assert rows[-1]["target"] == pytest.approx([0.2, -1.5, 1.5, -1.5, -1.5, 0.1])
    assert 0 < rows[-1]["ctrl"][0] < 0.2
    assert 0 < rows[-1]["qpos"][0] < 0.2


def test_a_failing_trace_does_not_stop_the_simulation(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    world = ur5_world(pipe)
    world.open()
    try:
        os.close(reader)
        until(lambda: "tracing stopped" in caplog.text)
        stopped_s = world.snapshot().time_s
        until(lambda: world.snapshot().time_s > stopped_s)
        assert world.snapshot().fault == ""
    finally:
        world.close()


def test_invalid_worlds_are_rejected(tmp_path: Path, unbuilt: World):
    for use in (unbuilt.snapshot, lambda: unbuilt.model, lambda: unbuilt.step(1)):
        with pytest.raises(DriverError, match="not built"):
            use()
    scene = tmp_path / "bad.xml"
    for text in ("<mujoco><worldbody><geom/></worldbody></mujoco>", "not xml", ""):
        scene.write_text(text)
        with pytest.raises(DriverError, match="MuJoCo cannot build this world"):
            World(scene).build()
    with pytest.raises(DriverError, match=r"no joint 'ellbow'; the model has: shoulder_pan, "):
        World(UR5 / "scene.xml", home={"ellbow": 1.0}).build()
    for path in ("/dev/full", "/no/such/folder/trace.ndjson"):
        with pytest.raises(DriverError, match="cannot write the trace"):
            ur5_world(Path(path)).open()


def test_many_robots_share_a_world_and_move_apart(tmp_path: Path):
    room = tmp_path / "room.xml"
    room.write_text('<mujoco><option timestep="0.01"/></mujoco>')
    robots = [
        Placement(prefix=f"{name}/", model=UR5 / "ur5.xml", position_m=(2.0 * index, 0.0, 0.5))
        for index, name in enumerate("abcd")
    ]
    world = World(room, robots=robots, home={f"{name}/elbow": 0.5 for name in "abcd"})
    world.build()
    assert world.model.opt.timestep == TIMESTEP_S
    world.command("b", np.arange(6, 12), [0.3, 0.0, 0.5, 0.0, 0.0, 0.0], ramp_s=0.2)
    position = world.step(500).position_rad
    assert position["b/shoulder_pan"] == pytest.approx(0.3, abs=0.01)
    assert position["a/shoulder_pan"] == pytest.approx(0.0, abs=0.01)
    assert position["d/elbow"] == pytest.approx(0.5, abs=0.01)
