"""Power and hit rate of wires in a Gaussian beam, by diameter and number of rays per pulse.

    python benchmarks/wires.py

A wire of any direction passes the beam at any distance within its 1/e^2 radius. For each diameter over that
of the beam: the mean share of the power that the wire covers; for 7, 19 and 61 rays the mean share that rays
return, the root mean square error of one pulse and the share of pulses that hit the wire.
"""

import numpy as np

from lidar.sensors.laser.rays import INSIDE, bundle

PULSES = 100_000
RAYS = (7, 19, 61)


def disc(count: int) -> np.ndarray:
    """Sorted distances of points of equal power from a line through the beam's axis."""
    radius = np.sqrt(-0.5 * np.log1p(-INSIDE * (np.arange(count) + 0.5) / count))
    angle = 2 * np.pi * (np.arange(200) + 0.5) / 200
    return np.sort((radius[:, None] * np.cos(angle)).ravel())


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    offset, turn = rng.uniform(-1, 1, PULSES), rng.uniform(0, 2 * np.pi, PULSES)
    points = disc(2000)
    print("diameter   share" + "".join(f" | {n:2d} rays: mean    error   hit" for n in RAYS))
    for diameter in (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5):
        low, high = (np.searchsorted(points, offset + side * diameter) for side in (-1, 1))
        share = (high - low) / len(points)
        line = f"{diameter:8.3f} {share.mean():7.4f}"
        for rays in RAYS:
            x, y = bundle(rays).T
            away = np.cos(turn)[:, None] * x - np.sin(turn)[:, None] * y - offset[:, None]
            hits = (np.abs(away) < diameter).mean(axis=1)
            error = np.sqrt(np.mean((hits - share) ** 2))
            line += f" |          {hits.mean():6.4f} {error:7.4f} {np.mean(hits > 0):5.3f}"
        print(line)


if __name__ == "__main__":
    main()
