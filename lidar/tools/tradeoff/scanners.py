"""Errors and costs of the settings of a scanner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from geoscene.support.progress import Progress
from lidar.options import TradeoffOptions
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.devices import Scanner
from lidar.sensors.rig.scanner import firings
from lidar.tools.tradeoff.comparison import SensorComparison
from lidar.tools.tradeoff.costs import costs
from lidar.tools.tradeoff.errors import STATISTICS, FrameDifferences, PulseReturns, estimates, frame_error
from lidar.tools.tradeoff.notes import Notes
from lidar.tools.tradeoff.simulate import EXACT, FAST, Bench, chosen_pulses, frame_cost, returns_of
from lidar.tools.tradeoff.variants import (
    OF_EMBREE,
    SCANNER_VALUES,
    SettingVariant,
    next_step,
    scanner_basis,
    scanner_variants,
    without_each,
)
from lidar.world.settings import PLAIN as WHOLE
from lidar.world.settings import WorldSettings


def compared_scanner(
    bench: Bench, scanner: Scanner, *, compared: TradeoffOptions, scenes: Sequence[str], progress: Progress
) -> SensorComparison:
    """The comparison of a scanner; ``scenes`` are labels of the scenes after the first."""
    plan, settings = bench.plan, bench.plan.options.recording_settings
    basis = scanner_basis(
        settings.scanner, rays=compared.reference_rays, world=settings.world, built=plan.scene.relief
    )
    variants = scanner_variants(
        basis, compared=compared.compare, scenes=scenes, traffic=plan.actors is not None
    )
    frames = bench.frames[scanner.name]
    per_frame = -(-compared.pulses // len(frames))
    finer = replace(basis.exact, rays=next_step(basis.exact.rays))
    used: list[list[FrameDifferences]] = [[] for _ in variants]
    alone: list[list[FrameDifferences]] = [[] for _ in variants]
    residual: list[FrameDifferences] = []
    notes = Notes(bench, scanner, variants=variants)
    pulses = 0
    for k, frame in enumerate(frames):
        progress(f"comparing {scanner.name}", k, total=len(frames))
        count = len(firings(scanner.sensor, frame))
        look = _Look(
            bench, scanner, frame, chosen_pulses(count, per_frame, frame=frame, seed=plan.options.seed)
        )
        pulses += len(look.pulses)
        truth = look.returns(basis.exact, backend=EXACT)
        residual.append(frame_error(truth, look.returns(finer, backend=EXACT)))
        for i, variant in enumerate(variants):
            found = look.used(variant)
            used[i].append(frame_error(found, truth))
            for change, rest in without_each(basis, variant):
                notes.add(i, change, same=_equal(found, look.used(rest)))
            if len(variant.changes) == 1:
                alone[i].append(frame_error(look.alone(variant), truth))
    spent = costs(
        bench,
        scanner,
        variants=variants,
        frame_cost=lambda frame, world, variant: frame_cost(
            plan, scanner, frame=frame, world=world, settings=variant.used
        ),
        repetitions=compared.repetitions,
        progress=progress,
    )

    figures = partial(estimates, seed=plan.options.seed, statistics=STATISTICS)
    rows = notes.rows(
        basis.described(SCANNER_VALUES),
        used=[figures(errors) for errors in used],
        alone=[figures(errors) for errors in alone],
        spent=spent,
    )
    return SensorComparison(
        f"{scanner.name} ({scanner.spec.preset})",
        f"float64 ray casting, {basis.exact.rays} rays per pulse, a pose for every firing; 1.5 times as many"
        " rays",
        figures(residual),
        rows,
        pulses,
        len(frames),
    )


@dataclass(frozen=True, slots=True)
class _Look:
    """Some pulses of a frame, to be cast with different settings."""

    bench: Bench
    scanner: Scanner
    frame: int
    pulses: NDArray[np.int64]
    _known: dict[tuple[tuple[str, object], ...], PulseReturns] = field(default_factory=dict)

    def returns(
        self,
        settings: ScannerSettings,
        *,
        backend: str,
        scene: int = 0,
        traffic: bool = True,
        world: WorldSettings = WHOLE,
    ) -> PulseReturns:
        """The returns of these pulses."""
        around = self.bench.world(
            self.scanner, self.frame, backend=backend, scene=scene, traffic=traffic, settings=world
        )
        return returns_of(
            self.bench.plan,
            self.scanner,
            frame=self.frame,
            world=around,
            settings=settings,
            pulses=self.pulses,
        )

    def used(self, variant: SettingVariant[ScannerSettings]) -> PulseReturns:
        """The returns with the user's settings, changed as in a variant."""
        if variant.changes not in self._known:
            self._known[variant.changes] = self.returns(
                variant.used,
                backend=FAST,
                scene=variant.scene,
                traffic=variant.traffic,
                world=variant.world,
            )
        return self._known[variant.changes]

    def alone(self, variant: SettingVariant[ScannerSettings]) -> PulseReturns:
        """The returns of the reference, changed as in a variant."""
        return self.returns(
            variant.alone,
            backend=FAST if variant.names <= OF_EMBREE else EXACT,
            scene=variant.scene,
            traffic=variant.traffic,
            world=variant.alone_world,
        )


def _equal(one: PulseReturns, other: PulseReturns) -> bool:
    return np.array_equal(one.key, other.key) and np.array_equal(one.xyz, other.xyz)
