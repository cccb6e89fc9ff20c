"""A NAO: NAOqi's services on loopback, in a process of its own, under the Python that has ``qi``.

It prints its address, then answers each JSON line on its standard input with one on its standard output: see
``answer``. Joints move at a constant speed. A walk lasts until it is stopped.
"""

import collections
import json
import math
import sys
import threading
import time

import qi
import qi.logging

PERIOD_S = 0.002
SPEED_RAD_S = 2.0
REST_RAD_S = 1e-6


BEHAVIOURS: dict[str, list[tuple[float, dict[str, float]]]] = {
    "animations/Stand/Gestures/Hey_1": [(0.6, {"RShoulderPitch": 0.3, "HeadYaw": 0.4}), (0.6, {"HeadYaw": 0.2})],
    "User/long wave.1/behavior_1": [(60.0, {"HeadYaw": 1.9})],
    "walk": [(60.0, {})],
    "broken": [],
}
"""Installed behaviours: durations [s] and the targets of joints [rad]. ``walk`` walks; ``broken`` fails."""


class Body:
    """The robot without its services. Physics continue while the services are disturbed."""

    def __init__(self, joints, speeds, home):
        self.lock = threading.RLock()
        self.joints, self.speeds = joints, dict(zip(joints, speeds, strict=True))
        self.position = dict(zip(joints, home, strict=True))
        self.target, self.fraction = dict(self.position), 1.0
        self.commanded = self.position  # between position and target; this model follows it without a lag
        self.velocity = dict.fromkeys(joints, 0.0)
        self.stiffness = dict.fromkeys(joints, 1.0)
        self.walk, self.twist, self.pose = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self.fallen, self.fall_manager, self.posture = False, True, "Standing"
        self.spoken, self.calls, self.language = [], [], "English"
        self.speaking = threading.Event()
        self.running, self.stubborn = [], False
        self.memory: dict[str, int] = {}
        self.checks: collections.deque[float] = collections.deque(maxlen=400)
        self.inserted_s = 0.0
        self.disturbance, self.old_ms = "", 0
        self.rest_s: float | None = time.monotonic()
        threading.Thread(target=self.run, daemon=True).start()

    def run(self):
        before_s = time.monotonic()
        while True:
            time.sleep(PERIOD_S)
            now_s = time.monotonic()
            with self.lock:
                self.step(now_s - before_s)
            before_s = now_s

    def step(self, elapsed_s):
        for name, target in self.target.items():
            limit = min(SPEED_RAD_S, self.fraction * self.speeds[name]) * elapsed_s
            change = min(max(target - self.position[name], -limit), limit) if self.stiffness[name] else 0.0
            self.position[name] += change
            self.velocity[name] = change / elapsed_s
        self.twist = list(self.walk)
        for index, value in enumerate(self.twist):
            self.pose[index] += value * elapsed_s
        if any(self.twist) or any(abs(value) > REST_RAD_S for value in self.velocity.values()):
            self.rest_s = None
        elif self.rest_s is None:
            self.rest_s = time.monotonic()

    def stop_itself(self):
        self.walk, self.target, self.fallen = [0.0, 0.0, 0.0], dict(self.position), True
        self.stiffness = dict.fromkeys(self.joints, 0.0)

    def rest(self, names):
        """End the motion of joints where they are."""
        with self.lock:
            self.target.update({name: self.commanded[name] for name in names})

    def command(self, name):
        """Whether to execute a command now."""
        self.calls.append(name)
        del self.calls[:-100]
        return self.disturbance != "safety"

    def values(self, names, values):
        """Values as the services return them."""
        while self.disturbance == "silence":
            time.sleep(0.01)
        result = [values[name] for name in names]
        if self.disturbance == "nan":
            return [math.nan] * len(result)
        if self.disturbance == "truncated":
            return result[:-1]
        return ["\x00\xffgarbage"] * len(result) if self.disturbance == "garbage" else result


@qi.multiThreaded()
class ALMotion:
    def __init__(self, body):
        self.body = body

    def getBodyNames(self, name):
        return list(self.body.joints)

    def getLimits(self, name):
        return [[-3.0, 3.0, self.body.speeds[name], 1.0]]

    def getAngles(self, names, use_sensors):
        if isinstance(names, str):
            names = self.body.joints
        with self.body.lock:
            position = dict(self.body.position if use_sensors else self.body.commanded)
        return self.body.values(names, position)

    def setAngles(self, names, angles, fraction):
        if not 0 < fraction <= 1 or not all(map(math.isfinite, angles)):
            raise RuntimeError("setAngles: invalid argument")
        with self.body.lock:
            if self.body.command("setAngles"):
                self.body.fraction = fraction
                self.body.target.update(zip(names, angles, strict=True))

    def move(self, x, y, theta):
        with self.body.lock:
            if self.body.command("move"):
                self.body.walk = [x, y, theta]

    def stopMove(self):
        with self.body.lock:
            self.body.command("stopMove")
            self.body.walk = [0.0, 0.0, 0.0]

    def killTasksUsingResources(self, names):
        self.body.rest(names)

    def killAll(self):
        with self.body.lock:
            self.body.command("killAll")
            self.body.walk = [0.0, 0.0, 0.0]
            self.body.rest(self.body.joints)

    def moveIsActive(self):
        return any(self.body.twist)

    def setMoveArmsEnabled(self, left, right):
        self.body.calls.append(f"setMoveArmsEnabled {left} {right}")

    def getStiffnesses(self, names):
        return [self.body.stiffness[name] for name in names]

    def setStiffnesses(self, names, value):
        with self.body.lock:
            for name in names:
                self.body.stiffness[name] = value
                self.body.target[name] = self.body.position[name]

    def getFallManagerEnabled(self):
        return self.body.fall_manager

    def getRobotPosition(self, use_sensors):
        return list(self.body.pose)

    def getRobotVelocity(self):
        return list(self.body.twist)


@qi.multiThreaded()
class ALMemory:
    def __init__(self, body):
        self.body = body

    def getData(self, key):
        if key == "DCM/Time":
            return self.body.old_ms if self.body.disturbance == "clock" else int(time.monotonic() * 1000)
        if key == "robotHasFallen":
            return 1.0 if self.body.fallen else 0.0
        if key == "Telescope/Beat":
            with self.body.lock:
                self.body.checks.append(time.monotonic())
        if key in self.body.memory:
            return self.body.memory[key]
        raise RuntimeError(f"no data '{key}'")

    def insertData(self, key, value):
        if key == "Telescope/Beat" and self.body.disturbance == "beats":
            return
        with self.body.lock:
            self.body.memory[key] = value
            self.body.inserted_s = time.monotonic() if key == "Telescope/Beat" else self.body.inserted_s

    def getListData(self, keys):
        return [float(30 + self.body.joints.index(key.split("/")[2])) for key in keys]


@qi.multiThreaded()
class ALRobotPosture:
    def __init__(self, body):
        self.body = body

    def getPostureFamily(self):
        return self.body.posture


@qi.multiThreaded()
class ALBehaviorManager:
    def __init__(self, body):
        self.body = body

    def getInstalledBehaviors(self):
        return list(BEHAVIOURS)

    def runBehavior(self, name):
        if name not in BEHAVIOURS or name == "broken":
            raise RuntimeError(f"runBehavior: '{name}' cannot be loaded")
        self.body.running.append(name)
        if name == "walk":
            self.body.walk = [0.05, 0.0, 0.0]
        for duration_s, targets in BEHAVIOURS[name]:
            with self.body.lock:
                self.body.fraction = 1.0
                self.body.target.update(targets)
            end_s = time.monotonic() + duration_s
            while time.monotonic() < end_s and name in self.body.running:
                time.sleep(0.005)
        self.body.running = [each for each in self.body.running if each != name]

    def isBehaviorRunning(self, name):
        return name in self.body.running

    def stopBehavior(self, name):
        self.body.calls.append(f"stopBehavior {name}")
        if not self.body.stubborn:
            self.body.running = [each for each in self.body.running if each != name]


@qi.multiThreaded()
class ALBattery:
    def getBatteryCharge(self):
        return 81


@qi.multiThreaded()
class ALTextToSpeech:
    def __init__(self, body):
        self.body = body

    def getLanguage(self):
        return self.body.language

    def setLanguage(self, language):
        if language == "Slovak":
            raise RuntimeError("the language Slovak is not installed")
        self.body.language = language

    def say(self, text):
        self.body.speaking.clear()
        self.body.spoken.append([self.body.language, text])
        self.body.speaking.wait(0.02 * len(text))

    def stopAll(self):
        self.body.calls.append("stopAll")
        self.body.speaking.set()


class Nao:
    def __init__(self, body):
        self.body = body
        self.url = "tcp://127.0.0.1:0"
        self.listen()

    def listen(self):
        self.session = qi.Session()
        self.session.listenStandalone(self.url)
        self.url = self.session.endpoints()[0]
        for service in (ALMotion, ALMemory, ALRobotPosture, ALTextToSpeech, ALBehaviorManager):
            self.session.registerService(service.__name__, service(self.body))
        self.session.registerService("ALBattery", ALBattery())

    def disturb(self, kind):
        self.body.old_ms = int(time.monotonic() * 1000)
        if kind == "order":
            self.body.joints.reverse()
        if kind == "safety":
            with self.body.lock:
                self.body.stop_itself()
        self.body.disturbance = kind
        if kind == "connection":
            with self.body.lock:
                self.body.walk, self.body.target = [0.0, 0.0, 0.0], dict(self.body.position)
            self.session.close()

    def restore(self):
        kind, self.body.disturbance = self.body.disturbance, ""
        if kind == "connection":
            self.listen()
        if kind == "safety":
            with self.body.lock:
                self.body.stiffness = dict.fromkeys(self.body.joints, 1.0)
                self.body.fallen = False

    def answer(self, request):
        if "disturb" in request:
            self.disturb(request["disturb"])
        if "restore" in request:
            self.restore()
        body = self.body
        with body.lock:
            for name, value in request.get("set", {}).items():
                setattr(body, name, value)
            state = (
                "position",
                "target",
                "velocity",
                "twist",
                "pose",
                "rest_s",
                "inserted_s",
                "stiffness",
                "fraction",
                "spoken",
                "calls",
                "language",
                "running",
            )
            return {name: getattr(body, name) for name in state} | {"checks": list(body.checks)}


def main(body):
    qi.logging.setLevel(qi.logging.FATAL)
    config = json.loads(sys.stdin.readline())
    nao = Nao(body(config["joints"], config["speeds"], config["home"]))
    print(json.dumps(nao.url), flush=True)
    for line in sys.stdin:
        print(json.dumps(nao.answer(json.loads(line))), flush=True)


if __name__ == "__main__":
    main(Body)
