"""Program: uses Telescope's plug-ins as LeRobot does. Runs under a Python that has LeRobot.

Arguments: folder of ``bridge.py``, kind (``robot`` or ``teleoperator``), URL, device. Each line on its standard input is
a call with its arguments; each answer is the result, or the kind and text of the error.
"""

import json
import sys
from pathlib import Path

folder, kind, url, device = sys.argv[1:]
sys.path.insert(0, folder)

import bridge  # type: ignore[import-not-found]  # noqa: E402

sys.modules.update({name: bridge.Placeholder(name) for name in bridge.UNUSED})

from lerobot.robots import RobotConfig, make_robot_from_config  # noqa: E402
from lerobot.teleoperators import TeleoperatorConfig, make_teleoperator_from_config  # noqa: E402
from lerobot.utils.import_utils import register_third_party_plugins  # noqa: E402

register_third_party_plugins()
config_class, make = {
    "robot": (RobotConfig, make_robot_from_config),
    "teleoperator": (TeleoperatorConfig, make_teleoperator_from_config),
}[kind]
used = make(config_class.get_choice_class("telescope")(id="test", device=device, url=url))
assert Path(bridge.__file__).parent == Path(folder)
for line in sys.stdin:
    name, *arguments = json.loads(line)
    try:
        result = getattr(used, name)
        result = result(*arguments) if callable(result) else result
        answer = {
            "result": {key: str(value) if isinstance(value, type) else value for key, value in result.items()}
            if isinstance(result, dict)
            else result
        }
    except Exception as error:  # noqa: BLE001 (the test judges it)
        answer = {"kind": type(error).__name__, "error": str(error)}
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()
