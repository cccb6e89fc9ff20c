"""Starts LeRobot's loader of datasets in its own environment."""

import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tests.harness.paths import LEROBOT_DATASET_PYTHON

_PROGRAM: Final = Path(__file__).with_name("load_dataset.py")
_PATIENCE_S: Final = 1200
"""The loader needs half a minute of processor time, of which a busy machine gives it a small share [s]."""
_GRAPHICS_LIBRARIES: Final = (
    "libcublas.so.13", "libcublasLt.so.13", "libcudnn.so.9", "libcufft.so.12", "libcufile.so.0", "libcupti.so.13",
    "libcurand.so.10", "libcusparse.so.12", "libcusparseLt.so.0", "libnccl.so.2", "libnvshmem_host.so.3",
)  # fmt: skip
"""What PyTorch 2.11 for x86_64 Linux requests at its start, and does not use without a graphics card (2 GB)."""


@dataclass(frozen=True)
class Loaded:
    """What LeRobot's loader returned: arrays of all frames by feature, and facts of the dataset."""

    arrays: dict[str, NDArray[Any]]
    facts: dict[str, Any]


def load(datasets: Sequence[Path], folder: Path) -> dict[str, Loaded]:
    """Read datasets with LeRobot's loader, without a network; returns them by the name of their folder."""
    assert LEROBOT_DATASET_PYTHON.exists(), (
        "LeRobot's loader is missing: install Python 3.12 or 3.13 and run `make test-long`"
    )
    folder.mkdir()
    environment = {
        **os.environ,
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
        "HF_HOME": str(folder / "cache"),
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, _libraries(folder / "libraries"))),
    }
    command = [str(LEROBOT_DATASET_PYTHON), str(_PROGRAM), str(folder), *map(str, datasets)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=_PATIENCE_S)
    assert run.returncode == 0, run.stderr[-4000:]
    return {
        path.name: Loaded(
            dict(np.load(folder / f"{path.name}.npz")), json.loads((folder / f"{path.name}.json").read_text())
        )
        for path in datasets
    }


def _libraries(folder: Path) -> list[Path]:
    """Folders with the libraries that PyTorch requests: NVIDIA's small one, and a link for each of the others.

    Each link leads to the same small library, which has no symbol versions, so the system accepts it under each name.
    """
    packages = next((LEROBOT_DATASET_PYTHON.parents[1] / "lib").glob("python3.*")) / "site-packages"
    stand_in = next((packages / "markupsafe").glob("_speedups*.so"))
    folder.mkdir()
    for name in _GRAPHICS_LIBRARIES:
        (folder / name).symlink_to(stand_in)
    return [folder, packages / "nvidia" / "cu13" / "lib"]
