"""Program: read datasets with LeRobot's own loader, and store what it returns as arrays.

Arguments: folder for the results, then the datasets. It runs with the Python of LeRobot, so it imports nothing of this
repository.
"""

import json
import os
import sys
from pathlib import Path

# The functions of PyTorch for graphics cards are resolved when they are called, that is, never (see ``loader.py``).
sys.setdlopenflags(os.RTLD_LAZY)

import numpy as np  # noqa: E402 (after the flags)
import torch  # noqa: E402 (after the flags)
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402 (after the flags)


def main() -> None:
    """Read all datasets."""
    results = Path(sys.argv[1])
    for root in map(Path, sys.argv[2:]):
        dataset = LeRobotDataset(f"local/{root.name}", root=root)
        items = [dataset[index] for index in range(len(dataset))]
        arrays = {
            key: torch.stack([torch.as_tensor(item[key]) for item in items]).numpy()
            for key in items[0]
            if key != "task"
        }
        np.savez(results / f"{root.name}.npz", **arrays)
        facts = {
            "tasks": [item["task"] for item in items],
            "episodes": [dict(row) for row in dataset.meta.episodes],
            "successful": dataset.meta.filter_episodes(lambda row: row["success"]),
            "num_episodes": dataset.num_episodes,
            "num_frames": dataset.num_frames,
            "fps": dataset.fps,
            "robot_type": dataset.meta.robot_type,
            "names": {key: dataset.meta.features[key]["names"] for key in ("observation.state", "action")},
            "mean_action": dataset.meta.stats["action"]["mean"].tolist(),
            "mean_image": {key: dataset.meta.stats[key]["mean"].tolist() for key in dataset.meta.camera_keys},
        }
        (results / f"{root.name}.json").write_text(json.dumps(facts), encoding="utf-8")


main()
