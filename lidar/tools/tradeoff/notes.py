"""Notes on rows: what figures do not say, such as that a setting has no effect."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lidar.sensors.rig.devices import Camera, Scanner
from lidar.tools.tradeoff.comparison import VariantRow
from lidar.tools.tradeoff.errors import ErrorEstimate
from lidar.tools.tradeoff.simulate import FAST, Bench
from lidar.tools.tradeoff.variants import KINDS, MODELS, SettingVariant
from lidar.world.settings import WorldSettings


class Notes:
    """Gathers over frames which changes make no difference to a sensor, and says so."""

    def __init__(
        self, bench: Bench, sensor: Scanner | Camera, *, variants: Sequence[SettingVariant[Any]]
    ) -> None:
        self._bench = bench
        self._sensor = sensor
        self._variants = variants
        self._same: list[dict[str, bool]] = [{} for _ in variants]

    def add(self, row: int, change: str, *, same: bool) -> None:
        """Enter whether a frame of a variant is the same without one of its changes."""
        self._same[row][change] = same and self._same[row].get(change, True)

    def of(self, row: int) -> str:
        """The note of a variant."""
        variant, idle = self._variants[row], [change for change, same in self._same[row].items() if same]
        texts = []
        if idle and len(variant.changes) > 1:
            texts.append(f"no effect on what was sampled: {', '.join(idle)}")
        elif idle and variant.names & set(KINDS) and self._absent(variant):
            texts.append("no effect here: there are none within reach")
        elif idle and "blur" in variant.names and _takes_no_time(self._sensor):
            texts.append("no effect here: the camera's exposure takes no time (exposure_ns is 0)")
        elif idle:
            texts.append("no effect on what was sampled, with the other settings as asked")
        if variant.names & MODELS:
            texts.append("changes what is modelled")
        return "; ".join(texts)

    def choice(self, row: int) -> bool:
        """Whether a drive may choose a variant, and each of its changes has an effect on what was sampled.

        A change without one may have a rare effect elsewhere, of unknown size, or saves nothing.
        """
        return self._variants[row].choice and not any(self._same[row].values())

    def rows(
        self,
        asked: str,
        *,
        used: Sequence[dict[str, ErrorEstimate]],
        alone: Sequence[dict[str, ErrorEstimate]],
        spent: Sequence[dict[str, ErrorEstimate]],
        further: Sequence[str] = (),
    ) -> tuple[VariantRow, ...]:
        """Rows of the variants.

        asked   : the settings as asked, in words
        further : notes of each variant beside these
        """
        return tuple(
            VariantRow(
                variant.label or f"as asked ({asked})",
                used[i],
                alone[i],
                spent[i],
                "; ".join(text for text in (self.of(i), *further[i : i + 1]) if text),
                self.choice(i),
            )
            for i, variant in enumerate(self._variants)
        )

    def _absent(self, variant: SettingVariant[Any]) -> bool:
        """Whether a variant's world holds as many faces and instances as the one of the settings as asked."""
        sizes = {self._size(of.world) for of in (variant, self._variants[0])}
        return len(sizes) == 1

    def _size(self, settings: WorldSettings) -> tuple[int, int]:
        frame = self._bench.frames[self._sensor.name][0]
        faces = self._bench.world(self._sensor, frame, backend=FAST, settings=settings).faces
        return len(faces.packed), len(faces.start)


def _takes_no_time(sensor: Scanner | Camera) -> bool:
    return isinstance(sensor, Camera) and sensor.spec.exposure_ns == 0
