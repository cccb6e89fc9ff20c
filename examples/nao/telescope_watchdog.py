#!/usr/bin/env python
"""Stops a NAO that has lost its connection to Telescope. It runs on the robot, with NAOqi's own Python 2.7 or newer.

NAOqi has no timeout: a walk continues when the network fails. The agent's bridge counts in ``Telescope/Beat`` of
``ALMemory``, and this program repeats the number in ``Telescope/Echo``. When the number does not change any more, it
ends the walk and holds the joints. The echo also contains how often it did. See docs/robots/nao.md.

The only argument is the address of NAOqi; it is ``tcp://127.0.0.1:9559`` without one.
"""

from __future__ import print_function

import sys
import time

import qi

BEAT, ECHO = "Telescope/Beat", "Telescope/Echo"
CHECK_S = 0.02
BEATS_S = 0.12
"""The robot stops when the number has not changed for this time [s]."""
LATE_S = 120.0
"""TCP may deliver commands of a lost connection for this time [s]. Until then every motion is stopped again."""
LAG_RAD = 0.1
"""Largest distance of a joint that holds from its command [rad]."""
MOVED_RAD = 0.02
FRACTION = 0.2
"""Speed at which a joint returns to its measured angle, as a share of the highest."""
LEGS = ("Hip", "Knee", "Ankle")


class Watchdog:
    """Checks the beats.

    Time is counted in checks: Python 2.7 has no monotonic clock.

    Args:
        memory: The service ``ALMemory``.
        motion: The service ``ALMotion``.
    """

    def __init__(self, memory, motion):
        self._memory = memory
        self._motion = motion
        self._names = motion.getBodyNames("Body")
        memory.insertData(BEAT, 0)
        self._last = self._missed = self._stops = 0
        self._held = True
        self._targets = {}

    def check(self):
        """Stop the robot if the beats have ended. The number 0 means that they have ended on purpose."""
        beat = self._memory.getData(BEAT)
        if beat != self._last:
            self._last, self._missed, self._held = beat, 0, beat == 0
            self._memory.insertData(ECHO, [beat, self._stops])
        elif self._last:
            self._missed += 1
            self._stop(self._missed * CHECK_S)

    def _stop(self, silent_s):
        if BEATS_S < silent_s < LATE_S:
            if not self._held or self._motion.moveIsActive():
                self._motion.stopMove()
            if not self._held or self._has_new_commands():
                self._stops += 1
                self._hold()
                self._held = True

    def _has_new_commands(self):
        """Whether a joint is commanded to leave the angle that it holds."""
        commanded = zip(self._names, self._motion.getAngles(self._names, False))
        return any(abs(angle - self._targets.get(name, angle)) > MOVED_RAD for name, angle in commanded)

    def _hold(self):
        """Keep the present commands, which carry the load. NAOqi moves the legs to the end of the last step."""
        walks = self._motion.moveIsActive()
        targets = {}
        measured, commanded = self._motion.getAngles(self._names, True), self._motion.getAngles(self._names, False)
        for name, angle, command in zip(self._names, measured, commanded):
            if not (walks and any(part in name for part in LEGS)):
                targets[name] = command if abs(command - angle) < LAG_RAD else angle
        self._motion.setAngles(list(targets), list(targets.values()), FRACTION)
        self._targets = targets


def main(url):
    """Serve until NAOqi ends; returns the exit code."""
    session = qi.Session()
    session.connect(url)
    watchdog = Watchdog(session.service("ALMemory"), session.service("ALMotion"))
    print("ready")
    sys.stdout.flush()
    while session.isConnected():
        time.sleep(CHECK_S)
        try:
            watchdog.check()
        except RuntimeError as error:  # the next check repeats it
            print("telescope watchdog: %s" % error, file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else "tcp://127.0.0.1:9559"))
