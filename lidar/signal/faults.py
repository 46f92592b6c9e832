"""Faults of sensors and of their links: lost packets, lost rows of images, a cover glass that absorbs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidar.parameters import parameter
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.laser.cloud import TracedCloud
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses, Stage


@dataclass(frozen=True)
class DroppedPackets(Stage):
    """Packets of consecutive firings are lost, in bursts (Gilbert 1960, Elliott 1963).

    A two-state Markov chain from packet to packet, which starts each frame in its stationary distribution:
    its mean share of lost packets is ``loss``, and the mean length of a run of them is ``burst``.
    """

    loss: float = parameter(0.01, "share of packets that are lost", low=0, high=1)
    burst: float = parameter(1.0, "mean number of consecutive packets lost together", low=1, high=1e6)
    columns: int = parameter(
        24, "firing blocks (azimuth steps) a packet; 24 for a VLP-16", low=1, high=100_000
    )

    def cloud(self, cloud: TracedCloud, *, at: Situation, rng: np.random.Generator) -> TracedCloud:
        """The cloud without the returns of lost packets."""
        del at
        packet = cloud.column // self.columns
        recover = 1 / self.burst
        # A loss that the burst length cannot reach has the next packet lost for certain.
        fail = min(recover * self.loss / (1 - self.loss), 1.0) if self.loss < 1 else 1.0
        draws = rng.random(int(packet.max(initial=-1)) + 1)
        lost = np.empty(len(draws), bool)
        bad = False
        for k, draw in enumerate(draws):
            chance = self.loss if k == 0 else (1 - recover if bad and self.loss < 1 else fail)
            lost[k] = bad = bool(draw < chance)
        return cloud.where(~lost[packet])


@dataclass(frozen=True)
class LostRows(Stage):
    """Bands of image rows are lost on the link from the camera and stay black."""

    loss: float = parameter(0.01, "probability that a band is lost", low=0, high=1)
    rows: int = parameter(8, "image rows a band", low=1, high=100_000)

    def image(self, frame: CameraImage, *, at: Situation, rng: np.random.Generator) -> CameraImage:
        """The frame with its lost bands black; depth and labels stay."""
        del at
        rgb = frame.rgb
        assert rgb is not None  # noqa: S101
        bands = -(-len(rgb) // self.rows)
        lost = np.repeat(rng.random(bands) < self.loss, self.rows)[: len(rgb)]
        return replace(frame, rgb=np.where(lost[:, None, None], np.uint8(0), rgb))


@dataclass(frozen=True)
class CoverGlass(Stage):
    """A dirty or tinted cover glass attenuates the echoes of a sector, on both ways through it."""

    transmission: float = parameter(0.9, "share of the power that passes, one way", low=0, high=1)
    azimuth: float = parameter(
        0.0, "middle of the sector, from forward to the left", unit="degrees", low=-360, high=360
    )
    width: float = parameter(360.0, "width of the sector", unit="degrees", low=0, high=360)

    def echoes(
        self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation, rng: np.random.Generator
    ) -> TracedEchoes:
        """The echoes with the power that is left."""
        del at, rng
        x, y = pulses.direction[echoes.pulse, :2].T
        off = (np.degrees(np.arctan2(y, x)) - self.azimuth + 180) % 360 - 180
        share = np.where(np.abs(off) <= self.width / 2, self.transmission**2, 1.0)
        return replace(echoes, apparent=echoes.apparent * share)
