"""What figures in SVG show."""

import base64
import io
import re

import numpy as np
from PIL import Image


def lines(svg, name):
    """Corners (n, 2) of each unbroken line of a series, in the units of the SVG."""
    (path,) = re.findall(rf'<g id="{name}">\s*<path d="([^"]+)"'.encode(), svg)
    return [
        np.array(re.sub(rb"[A-Za-z]", b" ", part).split(), float).reshape(-1, 2)
        for part in path.split(b"M")[1:]
    ]


def images(svg):
    """Pixels (h, w, 4) of the rasters of a figure."""
    found = re.findall(rb'base64,([^"]+)" id="[^"]+" width="\d+" height="\d+" transform="matrix', svg)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGBA")) for data in found]
