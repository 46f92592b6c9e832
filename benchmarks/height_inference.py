"""Accuracy of inferred building heights: known heights are hidden, inferred and compared.

    python benchmarks/height_inference.py EXTRACT [EXTRACT ...] [--json]

For every extract, shares of the buildings with tagged heights (height, est_height, building:levels, or those
of parts) are hidden at random and inferred from the rest. The comparison is a constant height for all: 10 m,
and the best constant, the median of the remaining heights (of the hidden ones if all are hidden). With 5 %
hidden the map is nearly complete; with all hidden only the type and the footprint of buildings remain.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import shapely

from geoscene.buildings import read_buildings
from geoscene.buildings.heights import infer_heights
from geoscene.geometry.frames import Frame
from geoscene.sources import read_osm

HIDDEN = (0.05, 0.2, 0.5, 0.9, 1.0)
CONSTANT = 10.0


def errors(path: Path) -> list[dict[str, float]]:
    """Median and 90th percentile of the absolute error, metres, per share of heights hidden."""
    osm = read_osm(path)
    west, south, east, north = osm.bounds
    table, _ = read_buildings(osm, Frame.at((west + east) / 2, (south + north) / 2))
    whole = ~table.is_part
    footprint = table.footprint[whole]
    xy = shapely.get_coordinates(shapely.point_on_surface(footprint))
    use, area = table.use[whole], shapely.area(footprint)
    tagged = np.isin(table.height_source[whole], ["tag", "est_height", "levels", "parts"])
    truth = np.where(tagged, table.height[whole], np.nan)
    known = np.flatnonzero(tagged)
    rows = []
    for share in HIDDEN:
        rng = np.random.default_rng(0)
        count = max(1, round(share * len(known)))
        rounds = 1 if share == 1 else max(4, round(4 / share))  # every building is hidden about four times
        wrong, tens, best, inside = [], [], [], []
        for _ in range(rounds):
            hidden = rng.permutation(known)[:count]
            left = truth.copy()
            left[hidden] = np.nan
            height, sigma, _ = infer_heights(xy, use, area=area, height=left)
            error = np.abs(height[hidden] - truth[hidden])
            wrong.append(error)
            inside.append(error < sigma[hidden])
            tens.append(np.abs(CONSTANT - truth[hidden]))
            rest = truth[hidden] if share == 1 else left[np.isfinite(left)]
            best.append(np.abs(np.median(rest) - truth[hidden]))
        rule, ten, median = (np.concatenate(e) for e in (wrong, tens, best))
        rows.append(
            {"hidden": share, "known": len(known)}
            | {f"{name}_{q}": float(np.quantile(e, q / 100)) for name, e in
               (("rule", rule), ("constant", ten), ("best_constant", median)) for q in (50, 90)}
            | {"within_sigma": float(np.concatenate(inside).mean())}
        )  # fmt: skip
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("extract", nargs="+", type=Path)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = {path.name.split(".")[0]: errors(path) for path in arguments.extract}
    if arguments.json:
        print(json.dumps(found, indent=2))
        return
    print("absolute error, metres: median / 90th percentile")
    print(f"{'extract':24}{'hidden':>8}{'rule':>15}{'10 m':>15}{'best constant':>15}{'in 1 sigma':>12}")
    for name, rows in found.items():
        for r in rows:
            pairs = "".join(
                f"{r[f'{k}_50']:8.2f} /{r[f'{k}_90']:5.1f}" for k in ("rule", "constant", "best_constant")
            )
            print(f"{name:24}{r['hidden']:8.0%}{pairs}{r['within_sigma']:12.0%}")


if __name__ == "__main__":
    main()
