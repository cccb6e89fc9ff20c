"""Folders of the repository."""

import os
import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
ROBOTS: Final = ROOT / "robots"
UR5: Final = ROBOTS / "ur5"
NAOQI_PYTHON: Final = Path(os.environ.get("TELESCOPE_NAOQI_PYTHON", Path(sys.prefix) / "naoqi" / "bin" / "python"))
"""Interpreter with NAOqi's library; `make test` installs it. The variable names another one."""
_LEROBOT = Path(sys.prefix) / "lerobot" / "bin" / "python"
LEROBOT_PYTHON: Final = Path(os.environ.get("TELESCOPE_LEROBOT_PYTHON", _LEROBOT))
"""Interpreter with LeRobot; `make test` installs it. The variable names another one."""
