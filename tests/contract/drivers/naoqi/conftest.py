"""A NAO, drivers for it, and scripts of its owner."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.drivers import load
from device_agent.drivers.naoqi.driver import NaoqiDriver
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import NAOQI_PYTHON, ROBOTS
from tests.harness.robots.naoqi.control_thread import MakeNao
from tests.harness.robots.naoqi.peer import NaoPeer

ENDLESS = """
import os, pathlib, subprocess, sys, time
import qi
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
session = qi.Session()
session.connect(os.environ["NAOQI_URL"])
motion = session.service("ALMotion")
motion.move(0.05, 0.0, 0.0)
pathlib.Path("pids").write_text(f"{os.getpid()} {child.pid} {os.environ['NAO_IP']} {os.environ['NAO_PORT']}")
while True:
    motion.setAngles(["HeadYaw"], [1.9], 0.1)
    time.sleep(0.02)
"""
TURN = """
import os, time
import qi
assert "SECRET" not in os.environ
session = qi.Session()
session.connect(os.environ["NAOQI_URL"])
motion = session.service("ALMotion")
motion.setAngles(["HeadYaw"], [0.3], 0.5)
while abs(motion.getAngles(["HeadYaw"], True)[0] - 0.3) > 0.01:
    time.sleep(0.02)
"""


@pytest.fixture
def nao() -> Iterator[NaoPeer]:
    """A NAO with simple joints."""
    peer = NaoPeer(robot_type.load(ROBOTS / "nao"), NAOQI_PYTHON)
    yield peer
    peer.close()


@pytest.fixture
def make_nao(nao: NaoPeer) -> Iterator[MakeNao]:
    """Creates connected drivers of this NAO."""
    made: list[NaoqiDriver] = []

    def create(**options: object) -> NaoqiDriver:
        driver = load("naoqi")(robot_type.load(ROBOTS / "nao"), ROBOTS / "nao", {**nao.options(), **options}, "nao")
        assert isinstance(driver, NaoqiDriver)
        made.append(driver)
        driver.connect()
        return driver

    yield create
    for driver in made:
        driver.close()


@pytest.fixture
def scripts(tmp_path: Path) -> Path:
    folder = tmp_path / "scripts"
    folder.mkdir(mode=0o700)
    for name, source in (("endless.py", ENDLESS), ("turn.py", TURN), ("fails.py", "raise ValueError('no arm')")):
        path = folder / name
        path.write_text(source)
        path.chmod(0o600)
    return folder
