"""Record labelled drives and read them as a network in training would: batches of NumPy arrays.

Writes to the folder given: two drives, and the mean and deviation of the points' columns as JSON. A
``torch.utils.data.DataLoader`` takes ``training`` as it is; here a loop stands for it.
"""

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

import geoscene
import lidar
from geoscene.classes import Class

out = Path(sys.argv[1] if len(sys.argv) > 1 else "training")
centre = geoscene.read_osm(geoscene.demo_path(), bounds=(24.9405, 60.1655, 24.9475, 60.1690))
scene = geoscene.build(centre, out / "scene", options=geoscene.BuildOptions(use="lidar"), overwrite=True)


def near(sample: dict[str, Any]) -> dict[str, Any]:
    """Only what is within 40 m of the scanner along both axes."""
    keep = np.abs(sample["points"][:, :2]).max(axis=1) < 40
    return sample | {name: sample[name][keep] for name in ("points", "label", "instance")}


drives = []
for seed in (1, 2):
    options = lidar.DriveOptions(
        route="random",
        rig="vlp16",
        duration=1.0,
        seed=seed,
        formats=("pcd",),
        traffic=lidar.TrafficOptions(vehicles=30, cyclists=8, pedestrians=60, parked=0.8),
    )
    drives.append(lidar.drive(scene, out / f"drive{seed}", options=options, overwrite=True).path)
data = lidar.training_data(drives, min_points=5, transform=near)
training, validation = data.split(0.8)
print(f"{len(training)} samples to train with, {len(validation)} to validate")

users, points = Counter[str](), Counter[str]()
total, squares, count = np.zeros(4), np.zeros(4), 0
order = np.random.default_rng(0).permutation(len(training))
for batch in np.array_split(order, len(order) // 4):
    samples = [training[k] for k in batch]
    for sample in samples:
        users.update(Class(k).name.lower() for k in sample["box_label"])
        points.update(Class(k).name.lower() for k in sample["label"])
        total += sample["points"].sum(axis=0, dtype=float)
        squares += (sample["points"].astype(float) ** 2).sum(axis=0)
        count += len(sample["points"])
mean = total / count
deviation = np.sqrt(squares / count - mean**2)
print("boxes:", ", ".join(f"{number} {name}" for name, number in users.most_common()))
print("points:", ", ".join(f"{number:,} {name}" for name, number in points.most_common(5)))
figures = {"columns": data.columns, "mean": mean.round(4).tolist(), "deviation": deviation.round(4).tolist()}
(out / "normalisation.json").write_text(json.dumps(figures, indent=1))
print(f"wrote {out / 'normalisation.json'}")
