"""Opens a dataset with LeRobot: `python lerobot_reader.py DATASET ROWS.npz`. Says on its last line what it found."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch

for operator in ("nms", "qnms"):  # torchvision's own, for pictures; they are missing where its CUDA is
    torch.library.define(f"torchvision::{operator}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402

path, rows = Path(sys.argv[1]), Path(sys.argv[2])
dataset = LeRobotDataset("local/dataset", root=path)
items = [dataset[number] for number in range(len(dataset))]
columns = {name: np.stack([item[name].numpy() for item in items]) for name in dataset.features}
np.savez(rows, **columns)
of_two = LeRobotDataset("local/dataset", root=path, episodes=[2, 5])
without_one = delete_episodes(dataset, [0], output_dir=rows.parent / "deleted", repo_id="local/deleted")
merged = merge_datasets([dataset, without_one], output_repo_id="local/merged", output_dir=rows.parent / "merged")
found = {
    "episodes": dataset.num_episodes,
    "fps": dataset.fps,
    "robot": dataset.meta.robot_type,
    "task": items[0]["task"],
    "of two": of_two.num_episodes,
    "without one": without_one.num_episodes,
    "merged": merged.num_episodes,
}
print(json.dumps(found))
