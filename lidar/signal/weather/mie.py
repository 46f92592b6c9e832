"""Scattering by spheres: the series of Mie (Bohren and Huffman 1983, chapter 4 and appendix A)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geoscene.support.compiled import njit
from geoscene.typing import Float


def mie_efficiencies(size: ArrayLike, index: complex) -> tuple[Float, Float, Float]:
    """Efficiencies (n,) of extinction, scattering and back-scatter of spheres.

    size  : (n,) size parameter, pi times diameter over wavelength
    index : refractive index over that of the air; a positive imaginary part absorbs

    The back-scatter efficiency is that of radar: 4 pi times the differential cross-section at 180 degrees,
    over the geometric one.
    """
    x = np.atleast_1d(np.asarray(size, float))
    extinction, scattering, back = np.empty_like(x), np.empty_like(x), np.empty_like(x)
    _efficiencies(x, complex(index), extinction, scattering, back)
    return extinction, scattering, back


@njit(cache=True, nogil=True)
def _efficiencies(size: Any, index: Any, extinction: Any, scattering: Any, back: Any) -> None:
    """Fill the Mie efficiencies (k,) of extinction, scattering and back-scatter."""
    for i in range(len(size)):
        x = size[i]
        y = x * index
        stop = int(x + 4.05 * x ** (1 / 3) + 2)
        # Logarithmic derivative of the Riccati-Bessel function psi(y), by downward recurrence from orders
        # that are beyond the transition at |y|, which is some |y|^(1/3) wide.
        terms = int(max(stop, abs(y) + 8 * abs(y) ** (1 / 3))) + 16
        derivative = np.zeros(terms + 1, np.complex128)
        for n in range(terms, 0, -1):
            derivative[n - 1] = n / y - 1.0 / (derivative[n] + n / y)
        psi0, psi1 = np.cos(x), np.sin(x)
        chi0, chi1 = -np.sin(x), np.cos(x)
        q_ext = q_sca = 0.0
        amplitude = 0.0 + 0.0j
        for n in range(1, stop + 1):
            psi = (2 * n - 1) / x * psi1 - psi0
            chi = (2 * n - 1) / x * chi1 - chi0
            xi, xi1 = complex(psi, -chi), complex(psi1, -chi1)
            electric = derivative[n] / index + n / x
            magnetic = derivative[n] * index + n / x
            a = (electric * psi - psi1) / (electric * xi - xi1)
            b = (magnetic * psi - psi1) / (magnetic * xi - xi1)
            q_ext += (2 * n + 1) * (a.real + b.real)
            q_sca += (2 * n + 1) * (abs(a) ** 2 + abs(b) ** 2)
            sign = 1.0 if n % 2 == 0 else -1.0
            amplitude += (2 * n + 1) * sign * (a - b)
            psi0, psi1 = psi1, psi
            chi0, chi1 = chi1, chi
        extinction[i] = 2 / (x * x) * q_ext
        scattering[i] = 2 / (x * x) * q_sca
        back[i] = abs(amplitude) ** 2 / (x * x)
