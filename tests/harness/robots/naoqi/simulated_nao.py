"""NAOqi's services of the simulated NAO: ``services.py`` with physics instead of its simple joints.

It runs under the tests' Python, which finds ``qi`` in the folder that its only argument names.
"""

import sys
import time

sys.path.append(sys.argv[1])

from device_agent.drivers.mujoco import BipedDriver, create
from device_agent.ports.driver import Twist
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROBOTS
from tests.harness.robots.naoqi import services

PERIOD_S = 0.02
REST_RAD_S = 0.02
REST_M_S = 0.01


class SimulatedBody(services.Body):
    """The robot in MuJoCo. Its walk is that of the simulation's driver; limp joints are not simulated."""

    def __init__(self, joints, speeds, home):
        kind = robot_type.load(ROBOTS / "nao")
        driver = create(kind, ROBOTS / "nao", {}, "nao")
        assert isinstance(driver, BipedDriver)
        self.driver = driver
        self.driver.connect()
        self.sent = list(home)
        self.names = [joint.name for joint in kind.joints]
        super().__init__(joints, speeds, home)

    def run(self):
        while True:
            time.sleep(PERIOD_S)
            with self.lock:
                self.exchange()

    def exchange(self):
        for index, name in enumerate(self.names):
            limit = min(services.SPEED_RAD_S, self.fraction * self.speeds[name]) * PERIOD_S
            self.sent[index] += min(max(self.target[name] - self.sent[index], -limit), limit)
        self.commanded = dict(zip(self.names, self.sent, strict=True))
        self.driver.send(self.sent)
        self.driver.drive(Twist(*self.walk))
        observation = self.driver.observe()
        self.position.update(zip(self.names, observation.position_rad, strict=True))
        self.velocity.update(zip(self.names, observation.velocity_rad_s, strict=True))
        odometry = self.driver.report("odometry")
        self.pose = [odometry["x_m"], odometry["y_m"], odometry["yaw_rad"]]
        self.twist = [odometry["forward_m_s"], odometry["left_m_s"], odometry["turn_rad_s"]]
        fast = any(abs(value) > REST_RAD_S for value in self.velocity.values())
        if fast or any(abs(value) > REST_M_S for value in self.twist):
            self.rest_s = None
        elif self.rest_s is None:
            self.rest_s = time.monotonic()


if __name__ == "__main__":
    services.main(SimulatedBody)
