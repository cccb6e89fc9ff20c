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
_NEW_LEROBOT = Path(os.environ.get("TELESCOPE_NEW_LEROBOT_PYTHON", Path(sys.prefix) / "lerobot-new" / "bin" / "python"))
LEROBOT_PYTHONS: Final = {"0.4.4": LEROBOT_PYTHON} | ({"0.6.1": _NEW_LEROBOT} if _NEW_LEROBOT.exists() else {})
"""Version of LeRobot → interpreter. A machine without Python 3.12 or 3.13 has only the first."""
_DATASET = Path(sys.prefix) / "lerobot-dataset" / "bin" / "python"
LEROBOT_DATASET_PYTHON: Final = Path(os.environ.get("TELESCOPE_LEROBOT_DATASET_PYTHON", _DATASET))
"""Interpreter with LeRobot's loader of datasets; `make test-long` installs it. The variable names another one."""
RERUN: Final = Path(os.environ.get("TELESCOPE_RERUN", Path(sys.prefix) / "rerun"))
"""Folder with Rerun's packages; `make test-long` installs it. The variable names another one."""
