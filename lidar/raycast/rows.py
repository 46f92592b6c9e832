"""Rows and columns of the kernels' arrays: in a packet of W lanes, row R of lane k is element R * W + k."""

OX, OY, OZ, DX, DY, DZ = range(6)
INVERSE, FAR, TIME = 6, 7, 8
"""Rows of the float64 array ``work`` for rays: origin, direction, 1 / length of the direction, far, time."""

NX, NY, NZ, OFFSET = 9, 10, 11, 12
SCALE, RANGE, COSINE, MARGIN = 13, 14, 15, 16
"""Rows of ``work`` for the hits: normal and offset of the plane, scale of the cosine, range, cosine, margin
of the face (see `lidar.raycast.geometry.Geometry`)."""

RAY_ROWS, WORK_ROWS = 9, 17
"""Number of rows of ``work`` for the rays, and for rays and hits."""

RAY_OX, RAY_OY, RAY_OZ, RAY_NEAR, RAY_DX, RAY_DY, RAY_DZ, RAY_TIME, RAY_FAR, RAY_MASK, RAY_ID = range(11)
HIT_U, HIT_V, HIT_FACE, HIT_GEOMETRY, HIT_INSTANCE, HIT_COPY = range(15, 21)
"""32-bit rows of Embree's RTCRayHitN: barycentric coordinates, face, geometry, geometry of instances,
copy within it."""

PACKET_RAY_ROWS, PACKET_ROWS = 12, 21
"""Number of rows of RTCRayN and of RTCRayHitN."""

PLANES, VERTICES, CORNERS, NUMBERS, START_NUMBER, NODES, ORDER, COUNT, MASK = range(9)
"""Columns of `lidar.raycast.columns.RayTarget.parts`: addresses of a geometry's planes, vertices, faces, face
numbers (0: consecutive), nodes and order of its tree; its first number, number of faces and mask."""
PART = 9
"""Number of columns of a part."""
