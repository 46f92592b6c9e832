"""Types that signatures name often."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

Height = Callable[[Float, Float], Float]
"""z (n,) in metres of the ground at scene x (n,), y (n,)."""
