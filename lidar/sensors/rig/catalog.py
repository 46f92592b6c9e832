"""Built-in rigs and sensors as rows of tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar.sensors.rig.scanner import Sensor, firings, load_sensor, sensor_names
from lidar.sensors.rig.specs import load_rig, rig_names


def sensor_rows() -> list[dict[str, Any]]:
    """One row per preset: name, maker, model, kind, channels, rates, range, wavelength and sources."""
    return [_sensor_row(name, load_sensor(name)) for name in sensor_names()]


def _sensor_row(name: str, sensor: Sensor) -> dict[str, Any]:
    pulses = firings(sensor, 0)
    elevation = np.degrees(np.arcsin(np.clip(pulses.direction[:, 2], -1, 1)))
    return {
        "name": name,
        "maker": sensor.maker,
        "model": sensor.model,
        "kind": sensor.kind,
        "channels": int(pulses.channel.max()) + 1 if sensor.kind == "spinning" else 1,
        "pulses_per_s": round(len(pulses) * sensor.rate_hz),
        "rate_hz": sensor.rate_hz,
        "elevation_deg": [round(float(elevation.min()), 2), round(float(elevation.max()), 2)],
        "min_range_m": sensor.min_range,
        "max_range_m": sensor.max_range,
        "wavelength_nm": sensor.wavelength_nm,
        "echoes": sensor.max_echoes,
        "return_mode": sensor.return_mode,
        "fmcw": sensor.fmcw,
        "note": sensor.note,
        "source": sensor.source,
    }


def rig_rows() -> list[dict[str, Any]]:
    """One row per rig: name, vehicle, sensors and the source of its figures."""
    rows = []
    for name in rig_names():
        rig = load_rig(name)
        rows.append(
            {
                "name": name,
                "vehicle": rig.vehicle,
                "lidars": {s.name: s.preset for s in rig.lidars},
                "cameras": {s.name: f"{s.width}x{s.height}" for s in rig.cameras},
                "gnss": [s.name for s in rig.gnss],
                "imus": [s.name for s in rig.imus],
                "source": rig.source,
            }
        )
    return rows
