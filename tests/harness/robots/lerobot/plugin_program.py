"""Program: uses Telescope's plug-ins as LeRobot does. Runs under a Python that has LeRobot.

Arguments: folder of ``bridge.py``, kind (``robot`` or ``teleoperator``), URL, device. Each line on its standard input
is a call with its arguments; each answer is the result, or the kind and text of the error.
"""

import json
import os
import sys
from typing import Any

folder, kind, url, device = sys.argv[1:]
sys.path.insert(0, folder)

import bridge  # type: ignore[import-not-found]  # noqa: E402 (LeRobot's Python does not have the agent)

sys.modules.update({name: bridge.Placeholder(name) for name in bridge.UNUSED})

from lerobot.robots import RobotConfig, make_robot_from_config  # noqa: E402 (after the placeholders)
from lerobot.teleoperators import TeleoperatorConfig, make_teleoperator_from_config  # noqa: E402
from lerobot.utils.import_utils import register_third_party_plugins  # noqa: E402


def call(used: Any, name: str, arguments: list[Any]) -> Any:
    """The result of a method or property; types by name."""
    value = getattr(used, name)
    result = value(*arguments) if callable(value) else value
    if isinstance(result, dict):
        return {key: each.__name__ if isinstance(each, type) else each for key, each in result.items()}
    return result


register_third_party_plugins()
config_class, make = {
    "robot": (RobotConfig, make_robot_from_config),
    "teleoperator": (TeleoperatorConfig, make_teleoperator_from_config),
}[kind]
robot = make(config_class.get_choice_class("telescope")(id="test", device=device, url=url))
opened: list[dict[str, Any]] = []
if period_s := os.environ.get("RENEW_PERIOD_S"):
    # Renews all credentials in each period, and counts those for setpoints as ``opened``.
    from lerobot_robot_telescope import client  # type: ignore[import-not-found]

    client.RENEW_S, client.RENEW_AFTER = float(period_s), 0.0
    open_control = client.Device._open_control

    def counted(used: Any, lease: dict[str, Any]) -> None:
        open_control(used, lease)
        opened.append(lease)

    client.Device._open_control = counted
for line in sys.stdin:
    method, *given = json.loads(line)
    try:
        answer = {"result": len(opened) if method == "opened" else call(robot, method, given)}
    except Exception as error:  # noqa: BLE001 (the test judges it)
        answer = {"kind": type(error).__name__, "error": str(error)}
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()
