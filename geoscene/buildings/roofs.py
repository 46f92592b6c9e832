"""roofs"""

import numpy as np
from geoscene.buildings.shells import prisms


def roof_shell(polygon, *, shape, low, high, roof_height, direction, across):
    return prisms(
        np.array([polygon], dtype=object), np.zeros(1, np.int64), np.array([low]), np.array([high])
    ), "not yet"
