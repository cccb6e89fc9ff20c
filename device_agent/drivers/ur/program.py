"""The URScript program that moves the robot. The controller executes it; setpoints arrive in RTDE input registers.

The program holds the robot until the setpoint counter changes. It approaches setpoints at no more than the joints'
maximum velocities. After rest it raises the velocity from zero, because a setpoint that follows a stop by the watchdog
may be a step away. If the counter does not change for ``WATCHDOG_S``, the program brakes and holds. It ends for good
when its session number appears in the register ``END``, so that a delayed setpoint moves nothing afterwards.
"""

from collections.abc import Sequence

WATCHDOG_S = 0.1
"""Longest time between two setpoints before the program brakes [s]."""

SESSION, COUNTER, END, CANCELLED = 24, 25, 26, 27
"""Integer input registers: the session, the counter of setpoints, the session that has to end, and the counter of a
setpoint that is not followed any more: the robot was stopped or paused meanwhile."""
TARGET = 24
"""First of six float input registers: the setpoint [rad]."""
RUNNING, BEAT = 24, 25
"""Integer output registers: the session of the running program, and a counter of its cycles.

Registers from 24 on are reserved for RTDE clients; lower ones belong to fieldbus adapters."""

_TEXT = """\
def telescope():
  session = {session}
  limit = {velocity}
  ramp = {ramp}
  timeout = {watchdog}
  counter = read_input_integer_register({COUNTER})
  q = get_target_joint_positions()
  age = 0.0
  since = 0.0
  beat = 0
  moving = False
  write_output_integer_register({RUNNING}, session)
  while read_input_integer_register({END}) != session:
    beat = beat + 1
    if beat > 1000000:
      beat = 0
    end
    write_output_integer_register({BEAT}, beat)
    newest = read_input_integer_register({COUNTER})
    age = age + get_steptime()
    if read_input_integer_register({SESSION}) == session and newest != counter:
      counter = newest
      age = 0.0
      if not moving:
        q = get_target_joint_positions()
        since = 0.0
        moving = True
      end
    end
    if not moving:
      sync()
    elif age > timeout or read_input_integer_register({CANCELLED}) == counter:
      stopj({braking})
      moving = False
    else:
      since = since + get_steptime()
      i = 0
      while i < 6:
        step = limit[i] * get_steptime()
        if ramp[i] * since < limit[i]:
          step = ramp[i] * since * get_steptime()
        end
        change = read_input_float_register({TARGET} + i) - q[i]
        if change > step:
          change = step
        elif change < -step:
          change = -step
        end
        q[i] = q[i] + change
        i = i + 1
      end
      servoj(q, 0, 0, get_steptime(), 0.05, 500)
    end
  end
  stopj({braking})
  write_output_integer_register({RUNNING}, 0)
end
"""


_RAMP = 2.0
"""Acceleration after rest as a multiple of the agent's limit, so that the agent's setpoints are not delayed."""


def script(
    session: int,
    *,
    max_velocity_rad_s: Sequence[float],
    max_acceleration_rad_s2: Sequence[float],
    braking_rad_s2: float,
) -> str:
    """The program of one session.

    Args:
        session: Number that no other session has.
        max_velocity_rad_s: Velocity limits of the joints, in the controller's order, shape (6,) [rad/s].
        max_acceleration_rad_s2: The agent's acceleration limits of the joints, shape (6,) [rad/s²].
        braking_rad_s2: Deceleration to rest [rad/s²].
    """
    return _TEXT.format(
        session=session,
        velocity=[float(value) for value in max_velocity_rad_s],
        ramp=[_RAMP * value for value in max_acceleration_rad_s2],
        watchdog=WATCHDOG_S,
        braking=float(braking_rad_s2),
        COUNTER=COUNTER,
        END=END,
        CANCELLED=CANCELLED,
        SESSION=SESSION,
        TARGET=TARGET,
        RUNNING=RUNNING,
        BEAT=BEAT,
    )
