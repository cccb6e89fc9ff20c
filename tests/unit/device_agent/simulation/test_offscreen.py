"""Selection of an OpenGL library, in child processes: a library stays in the process that loaded it."""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from tests.harness.paths import ROOT

pytestmark = pytest.mark.slow
HIDE = """
import ctypes, sys
hidden = tuple(sys.argv[1].split(","))
class Machine(ctypes.CDLL):
    def __init__(self, name, *arguments, **options):
        if name is not None and any(word in str(name) for word in hidden):
            raise OSError(f"{name}: cannot open shared object file")
        super().__init__(name, *arguments, **options)
ctypes.CDLL = ctypes.cdll._dlltype = Machine
"""
RENDER = """
import json
from types import SimpleNamespace
import mujoco
from device_agent.simulation import renderer
model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><light pos="0 0 3"/>
<geom type="sphere" size=".5" rgba="1 0 0 1"/><camera name="above" pos="0 0 2.5" fovy="60"/></worldbody></mujoco>''')
class World:
    def __init__(self):
        self.model = model
    def copy(self, data):
        mujoco.mj_forward(model, data)
renderer.TIMEOUT_S = 60.0
drawn = renderer.Renderer(World())
drawn.open()
rgb = drawn.render(0, width=64, height=48).pixels
depth = drawn.render(0, width=64, height=48, depth=True).pixels
drawn.close()
print(json.dumps({"red": rgb[24, 32].tolist(), "distance_m": float(depth[24, 32])}))
"""


def run(script: str, *, hidden: Sequence[str], settings: Mapping[str, str] | None = None) -> Any:
    done = subprocess.run(
        [sys.executable, "-c", HIDE + script, ",".join(hidden)],
        cwd=ROOT,
        env={"PATH": "/usr/bin:/bin", **(settings or {})},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    ("hidden", "settings"),
    [("libOSMesa.so", {}), ("none", {}), ("none", {"MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "osmesa"})],
    ids=["package", "system", "setting"],
)
def test_colours_and_depth_are_rendered_with_and_without_a_system_library(
    hidden: str, settings: Mapping[str, str]
) -> None:
    image = run(RENDER, hidden=(hidden,), settings=settings)
    red, green, blue = image["red"]
    assert red > 2 * max(green, blue)
    assert image["distance_m"] == pytest.approx(2.0, abs=0.01)


def test_missing_libraries_are_reported_with_their_remedy() -> None:
    report = run(
        """
import json
from device_agent.simulation import offscreen
try:
    offscreen.select()
except offscreen.SensorError as error:
    print(json.dumps(str(error)))
""",
        hidden=("libOSMesa", "libEGL"),
    )
    assert "no OpenGL library" in report
    assert "libosmesa6" in report
