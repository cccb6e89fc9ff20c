"""A robot type with one joint, and operations of the tests of robot types."""

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from function_app.entrypoints.hosts.worker import check_models
from tests.harness.cloud.cloud import Cloud, Person

MANIFEST = """
type = "TYPE"
version = 1
label = "Lever"
kind = "arm"
description = "One joint."
model = "lever.xml"
scene = "scene.xml"
driver = "mujoco"
period_ms = 8
braking_rad_s2 = 20.0
frames = ["tip"]
capabilities = ["joints", "movements"]
home_rad = { shoulder = 0.1 }

[[streams]]
name = "joints"
rate_hz = 20.0

[[joints]]
name = "shoulder"
label = "Shoulder"
lower_rad = -1.0
upper_rad = 1.0
max_velocity_rad_s = 2.0
max_acceleration_rad_s2 = 8.0
max_jerk_rad_s3 = 80.0
max_effort_nm = 20.0
"""
LEVER = """<mujoco model="lever"><compiler angle="radian"/>
  <worldbody>
    <body name="base">
      <geom type="box" size="0.05 0.05 0.05"/>
      <body name="beam">
        <joint name="shoulder" range="-1 1" axis="0 1 0" damping="1"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" mass="0.5"/>
        <site name="tip" pos="0 0 0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="shoulder" joint="shoulder" kp="50" ctrlrange="-1 1" forcerange="-20 20"/></actuator>
</mujoco>
"""
SCENE = """<mujoco>
  <include file="lever.xml"/>
  <worldbody><geom type="plane" size="1 1 0.1" pos="0 0 -0.2"/></worldbody>
</mujoco>
"""
FILES = {"lever.xml": LEVER, "scene.xml": SCENE}
TETRAHEDRON = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def manifest(robot_type: str = "lever", **changes: str) -> str:
    text = MANIFEST.replace("TYPE", robot_type)
    for old, new in changes.items():
        before = next(line for line in text.splitlines() if line.startswith(f"{old} = "))
        text = text.replace(before, f"{old} = {new}" if new else "", 1)
    return text


def add(person: Person, robot_type: str = "lever", *, wait_ms: int = 30_000, text: str = "", **files: str) -> Any:
    """Upload a robot type; ``lever__xml`` replaces ``lever.xml``."""
    changed = {name.replace("__", "."): content for name, content in files.items()}
    body = {"manifest": text or manifest(robot_type), "files": {**FILES, **changed}, "wait_ms": wait_ms}
    return person.post("/robot-types", body)


@contextlib.contextmanager
def checking(cloud: Cloud, count: int = 1) -> Iterator[None]:
    """Run model checkers in the background."""

    async def start() -> list[asyncio.Task[None]]:
        return [asyncio.create_task(check_models(cloud.functions, drain=False)) for _ in range(count)]

    async def stop(tasks: list[asyncio.Task[None]]) -> None:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    tasks = cloud.run(start())
    try:
        yield
    finally:
        cloud.run(stop(tasks))


def blobs(cloud: Cloud, prefix: str = "robot-types/") -> tuple[str, ...]:
    return cloud.run(cloud.functions.blobs.list(prefix))


def rows(cloud: Cloud, table: str, partition: str) -> list[str]:
    return [row.key for row in cloud.run(cloud.functions.tables.query(table, partition, limit=1000)).rows]


def check_all(cloud: Cloud) -> None:
    """Execute all pending model checks."""
    while cloud.run(cloud.functions.model_checks.run()):
        pass


def advance(cloud: Cloud, ms: int) -> None:
    cloud.clock.advance(ms / 1000)
    cloud.run(cloud.functions.scheduler._robot_types.run_due_jobs())


@contextlib.contextmanager
def killed_checker(cloud: Cloud) -> Iterator[None]:
    """Simulate the kill of a checker during compilation, before it stores a result."""

    class KilledError(Exception):
        pass

    async def killed(*_: object) -> tuple[str, ...]:
        raise KilledError

    with pytest.MonkeyPatch.context() as patch, contextlib.suppress(KilledError):
        patch.setattr(cloud.functions.model_checks._compiler, "check", killed)
        yield


def stop_after(cloud: Cloud, patch: pytest.MonkeyPatch, writes: int) -> None:
    """Simulate the kill of the functions after this number of writes."""
    left = writes

    def limited(call: Callable[..., Any]) -> Callable[..., Any]:
        async def call_counted(*arguments: Any, **options: Any) -> Any:
            nonlocal left
            left -= 1
            if left < 0:
                raise RuntimeError("killed")
            return await call(*arguments, **options)

        return call_counted

    for target, names in ((cloud.functions.tables, ("create", "replace", "batch")), (cloud.functions.blobs, ("put",))):
        for name in names:
            patch.setattr(target, name, limited(getattr(target, name)))
