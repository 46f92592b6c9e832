"""Kernels of Warp that find the first hits of rays in float64, as `lidar.raycast.exact` does on the CPU.

They traverse the same trees in the same order and evaluate the same expressions, without fused
multiplications and additions: they return the bytes of the float64 backend.
"""

from __future__ import annotations

import warp as wp

from lidar.geometry.box_tree import DEPTH as TREE_DEPTH
from lidar.geometry.box_tree import LEAF as TREE_LEAF
from lidar.raycast import lanes, planes
from lidar.raycast.exact import STACK
from lidar.raycast.rows import CORNERS, COUNT, MASK, NODES, NUMBERS, ORDER, PLANES, START_NUMBER, VERTICES

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

GRAZING = wp.constant(wp.float64(lanes.GRAZING))
START = wp.constant(wp.float64(lanes.START))
EXACT = wp.constant(wp.float64(planes.EXACT))
UNIT = wp.constant(wp.float64(lanes.UNIT))
HUGE = wp.constant(wp.float64(lanes.HUGE))
INF = wp.constant(wp.float64(float("inf")))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
FLAT = wp.constant(wp.float64(1e-100))
STEEP = wp.constant(wp.float64(1e100))
REACHED = wp.constant(wp.float64(1.0 + 1e-15))
LEAF = wp.constant(TREE_LEAF)
DEPTH = wp.constant(TREE_DEPTH)


@wp.struct
class WarpNode:
    """A row of `lidar.geometry.box_tree.Tree.nodes`."""

    low: wp.vec3f
    high: wp.vec3f
    right: wp.int32
    first: wp.int32


@wp.struct
class Plane:
    """A row of `lidar.raycast.geometry.Geometry.planes`."""

    normal: wp.vec3d
    offset: wp.float64
    margin: wp.float64


@wp.struct
class WarpBeam:
    """A ray with the inverse of its direction; the latter is huge where the direction is zero."""

    start: wp.vec3d
    way: wp.vec3d
    inverse: wp.vec3d


@wp.struct
class WarpTarget:
    """Columns of `lidar.raycast.columns.RayTarget`; addresses are of the device."""

    origin: wp.vec3d
    parts: wp.array2d[wp.int64]
    shape: wp.array[wp.int32]
    sizes: wp.array[wp.int32]
    masks: wp.array[wp.uint32]
    first: wp.array[wp.int64]
    steps: wp.array[wp.int64]
    transforms: wp.array2d[wp.float64]
    groups: wp.array2d[wp.int64]


@wp.struct
class WarpRays:
    """Columns of `lidar.raycast.columns.RayColumns`."""

    directions: wp.array[wp.vec3d]
    offsets: wp.array[wp.vec3d]
    pose: wp.array[wp.int64]
    position: wp.array[wp.vec3d]
    matrix: wp.array3d[wp.float64]
    order: wp.array[wp.int64]
    time: wp.array[wp.float32]
    near: wp.float64
    far: wp.array[wp.float64]
    mask: wp.int64


@wp.struct
class Pose:
    """The transform of an instance: rows of its matrix, and its translation."""

    x: wp.vec3d
    y: wp.vec3d
    z: wp.vec3d
    shift: wp.vec3d


@wp.struct
class WarpHit:
    """A face: row of ``parts`` (-1: none), number in it, instance (-1: none)."""

    row: wp.int32
    prim: wp.int32
    instance: wp.int32


@wp.func
def _invert(x: wp.float64) -> wp.float64:
    if wp.abs(x) > FLAT:
        return ONE / x
    return STEEP


@wp.func
def _beam(start: wp.vec3d, way: wp.vec3d) -> WarpBeam:
    beam = WarpBeam()
    beam.start = start
    beam.way = way
    beam.inverse = wp.vec3d(_invert(way[0]), _invert(way[1]), _invert(way[2]))
    return beam


@wp.func
def _enters(node: WarpNode, beam: WarpBeam, near: wp.float64, far: wp.float64) -> wp.float64:
    """The ray parameter at which a ray enters the box of a node; inf if it does not."""
    entry = near
    leaving = far
    for k in range(3):
        a = (wp.float64(node.low[k]) - beam.start[k]) * beam.inverse[k]
        b = (wp.float64(node.high[k]) - beam.start[k]) * beam.inverse[k]
        entry = wp.max(entry, wp.min(a, b))
        leaving = wp.min(leaving, wp.max(a, b))
    if entry <= leaving:
        return entry
    return INF


@wp.func
def _next_leaf(
    nodes: wp.array[WarpNode],
    beam: WarpBeam,
    near: wp.float64,
    far: wp.float64,
    stack: wp.array[wp.int32],
    bottom: int,
    start: int,
) -> tuple[int, int]:
    """The first item of the next leaf that a ray enters before ``far``, or -1, and the stack's new top."""
    top = int(start)
    while top > bottom:
        top -= 1
        node = int(stack[top])
        if _enters(nodes[node], beam, near, far) < INF:
            while node >= 0:
                right = nodes[node].right
                if right == 0:
                    return nodes[node].first, top
                one = _enters(nodes[node + 1], beam, near, far)
                two = _enters(nodes[right], beam, near, far)
                if wp.min(one, two) < INF:
                    left = node + 1
                    if one <= two:
                        stack[top] = right
                        node = left
                    else:
                        stack[top] = left
                        node = right
                    if wp.max(one, two) < INF:
                        top += 1
                else:
                    node = -1
    return -1, top


@wp.func
def _entry(
    transforms: wp.array2d[wp.float64], row: wp.int64, after: wp.int64, w: wp.float64, k: int
) -> wp.float64:
    return transforms[row, k] + w * (transforms[after, k] - transforms[row, k])


@wp.func
def _pose_of(target: WarpTarget, instance: int, time: wp.float64) -> Pose:
    """The transform of an instance at a ray time."""
    row = target.first[instance]
    steps = target.steps[instance]
    w = wp.float64(0.0)
    if steps > wp.int64(1):
        place = wp.min(wp.max(time, ZERO), ONE) * wp.float64(steps - wp.int64(1))
        step = wp.min(wp.int64(place), steps - wp.int64(2))
        row = row + step
        w = place - wp.float64(step)
    after = row
    if w > ZERO:
        after = row + wp.int64(1)
    m = target.transforms
    pose = Pose()
    pose.x = wp.vec3d(_entry(m, row, after, w, 0), _entry(m, row, after, w, 1), _entry(m, row, after, w, 2))
    pose.y = wp.vec3d(_entry(m, row, after, w, 4), _entry(m, row, after, w, 5), _entry(m, row, after, w, 6))
    pose.z = wp.vec3d(_entry(m, row, after, w, 8), _entry(m, row, after, w, 9), _entry(m, row, after, w, 10))
    pose.shift = wp.vec3d(
        _entry(m, row, after, w, 3), _entry(m, row, after, w, 7), _entry(m, row, after, w, 11)
    )
    return pose


@wp.func
def _within(pose: Pose, beam: WarpBeam) -> WarpBeam:
    """A ray in the frame of an instance."""
    u = wp.cross(pose.y, pose.z)
    v = wp.cross(pose.z, pose.x)
    w = wp.cross(pose.x, pose.y)
    scale = ONE / wp.dot(pose.x, u)
    o = (beam.start - pose.shift) * scale
    d = beam.way * scale
    return _beam(u * o[0] + v * o[1] + w * o[2], u * d[0] + v * d[1] + w * d[2])


@wp.func
def _let_pass(a: wp.vec3d, b: wp.vec3d, way: wp.vec3d, length: wp.float64, size: wp.float64) -> wp.float64:
    """Signed metres by which a ray passes an edge; 0 within rounding."""
    e = b - a
    edge = wp.sqrt(wp.dot(e, e))
    if not edge > ZERO:
        return ZERO
    passed = wp.dot(way, wp.cross(e, a)) / (length * edge)
    rounding = EXACT * (size + wp.abs(a[0]) + wp.abs(a[1]) + wp.abs(a[2]) + edge)
    if wp.abs(passed) <= rounding:
        return ZERO
    return passed


@wp.func
def _beside(beam: WarpBeam, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> bool:
    """Whether a ray passes outside the edges of a triangle; corners relative to the ray's origin."""
    length = wp.sqrt(wp.dot(beam.way, beam.way))
    size = wp.abs(beam.start[0]) + wp.abs(beam.start[1]) + wp.abs(beam.start[2])
    p = _let_pass(a, b, beam.way, length, size)
    q = _let_pass(b, c, beam.way, length, size)
    r = _let_pass(c, a, beam.way, length, size)
    return wp.min(-wp.min(p, wp.min(q, r)), wp.max(p, wp.max(q, r))) > ZERO


@wp.func
def _clip(t: wp.float64, beam: WarpBeam, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    """A ray parameter, clipped to the extent of corners along the ray; they are relative to its origin."""
    squared = wp.dot(beam.way, beam.way)
    one = wp.dot(a, beam.way) / squared
    two = wp.dot(b, beam.way) / squared
    three = wp.dot(c, beam.way) / squared
    low = wp.min(one, wp.min(two, three))
    high = wp.max(one, wp.max(two, three))
    if t > high:
        return high
    if t >= low:
        return t
    return low


@wp.func
def _range(
    plane: Plane, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, beam: WarpBeam, near: wp.float64, far: wp.float64
) -> wp.float64:
    """The ray parameter at which a ray hits a face after near, not at its start, and before far; else inf."""
    n = plane.normal
    o = beam.start
    along = wp.dot(n, beam.way)
    height = plane.offset - n[0] * o[0] - n[1] * o[1] - n[2] * o[2]
    grazing = along * along < GRAZING * GRAZING * wp.dot(beam.way, beam.way)
    t = height / along
    if not grazing and not (t < far and (t - near) * wp.abs(along) > START):
        return INF
    if (n[0] == ZERO and n[1] == ZERO and n[2] == ZERO) or _beside(beam, a, b, c):
        return INF
    if grazing:
        t = _clip(t, beam, a, b, c)
        if not (t < far and (t - near) * wp.abs(along) > START):
            return INF
    return t


@wp.func
def _first_of_part(
    target: WarpTarget, row: int, beam: WarpBeam, near: wp.float64, far: wp.float64, stack: wp.array[wp.int32]
) -> tuple[int, wp.float64]:
    """The first face of a part that a ray hits before ``far``, or -1, and its ray parameter."""
    count = int(target.parts[row, COUNT])
    best = wp.int32(-1)
    nearest = wp.float64(far)
    if count == 0:
        return best, nearest
    nodes = wp.array(ptr=wp.uint64(target.parts[row, NODES]), shape=(count,), dtype=WarpNode)
    order = wp.array(ptr=wp.uint64(target.parts[row, ORDER]), shape=(count,), dtype=wp.int32)
    faces = wp.array(ptr=wp.uint64(target.parts[row, CORNERS]), shape=(count,), dtype=wp.vec3i)
    planes = wp.array(ptr=wp.uint64(target.parts[row, PLANES]), shape=(count,), dtype=Plane)
    vertices = wp.array(ptr=wp.uint64(target.parts[row, VERTICES]), shape=(count,), dtype=wp.vec3d)
    stack[DEPTH] = 0
    first, top = _next_leaf(nodes, beam, near, nearest, stack, DEPTH, DEPTH + 1)
    while first >= 0:
        for k in range(first, wp.min(first + LEAF, count)):
            prim = order[k]
            corners = faces[prim]
            t = _range(
                planes[prim],
                vertices[corners[0]] - beam.start,
                vertices[corners[1]] - beam.start,
                vertices[corners[2]] - beam.start,
                beam,
                near,
                nearest,
            )
            if t < nearest:
                best = prim
                nearest = t
        first, top = _next_leaf(nodes, beam, near, nearest, stack, DEPTH, top)
    return best, nearest


@wp.func
def _first_hit(
    target: WarpTarget,
    near: wp.float64,
    far: wp.float64,
    mask: wp.int64,
    beam: WarpBeam,
    time: wp.float64,
    any_hit: bool,  # noqa: FBT001 - kernels have no keywords
) -> WarpHit:
    """The first face that a ray hits; some face if any hit will do."""
    stack = wp.zeros(shape=(STACK,), dtype=wp.int32)
    found = WarpHit()
    found.row = -1
    found.prim = -1
    found.instance = -1
    nearest = far * REACHED  # hits at far count
    for group in range(target.groups.shape[0]):
        count = int(target.groups[group, 2])
        start = int(target.groups[group, 3])
        nodes = wp.array(ptr=wp.uint64(target.groups[group, 0]), shape=(count,), dtype=WarpNode)
        order = wp.array(ptr=wp.uint64(target.groups[group, 1]), shape=(count,), dtype=wp.int32)
        stack[0] = 0
        first, top = _next_leaf(nodes, beam, near, nearest, stack, 0, wp.min(count, 1))
        while first >= 0:
            for k in range(first, wp.min(first + LEAF, count)):
                item = order[k]
                row = int(item)
                last = int(item) + 1
                instance = wp.int32(-1)
                local = beam
                if start >= 0:
                    instance = start + item
                    row = 0
                    last = 0
                    if wp.int64(target.masks[instance]) & mask != wp.int64(0):
                        local = _within(_pose_of(target, instance, time), beam)
                        row = target.shape[instance]
                        last = row + target.sizes[instance]
                for one in range(row, last):
                    if target.parts[one, MASK] & mask != wp.int64(0):
                        prim, t = _first_of_part(target, one, local, near, nearest, stack)
                        if prim >= 0:
                            found.row = one
                            found.prim = prim
                            found.instance = instance
                            nearest = t
                            if any_hit:
                                return found
            first, top = _next_leaf(nodes, beam, near, nearest, stack, 0, top)
    return found


@wp.func
def _turn(matrix: wp.array3d[wp.float64], p: wp.int64, v: wp.vec3d) -> wp.vec3d:
    return wp.vec3d(
        matrix[p, 0, 0] * v[0] + matrix[p, 0, 1] * v[1] + matrix[p, 0, 2] * v[2],
        matrix[p, 1, 0] * v[0] + matrix[p, 1, 1] * v[1] + matrix[p, 1, 2] * v[2],
        matrix[p, 2, 0] * v[0] + matrix[p, 2, 1] * v[1] + matrix[p, 2, 2] * v[2],
    )


@wp.func
def _ray(target: WarpTarget, rays: WarpRays, i: int) -> WarpBeam:
    """A ray relative to the origin of the target."""
    way = rays.directions[i]
    start = wp.vec3d(ZERO, ZERO, ZERO)
    offset = wp.vec3d(ZERO, ZERO, ZERO)
    count = rays.offsets.shape[0]
    if count == 1:
        offset = rays.offsets[0]
    if count > 1:
        offset = rays.offsets[i]
    if rays.pose.shape[0] > 0:
        p = rays.pose[i]
        way = _turn(rays.matrix, p, way)
        start = rays.position[p]
        if count > 0:
            start = start + _turn(rays.matrix, p, offset)
    else:
        start = offset
    return _beam(start - target.origin, way)


@wp.func
def _is_valid(beam: WarpBeam) -> bool:
    squared = wp.dot(beam.way, beam.way)
    size = wp.abs(beam.start[0]) + wp.abs(beam.start[1]) + wp.abs(beam.start[2])
    return squared > ZERO and squared < HUGE and size < HUGE


@wp.func
def _far(rays: WarpRays, i: int) -> wp.float64:
    if rays.far.shape[0] > 1:
        return rays.far[i]
    return rays.far[0]


@wp.func
def _time(rays: WarpRays, i: int) -> wp.float64:
    if rays.time.shape[0] > 0:
        return wp.float64(rays.time[i])
    return ZERO


@wp.func
def _number(rays: WarpRays, at: int) -> int:
    if rays.order.shape[0] > 0:
        return int(rays.order[at])
    return at


@wp.kernel
def cast(
    target: WarpTarget,
    rays: WarpRays,
    ranges: wp.array[wp.float64],
    faces: wp.array[wp.int32],
    instances: wp.array[wp.int32],
    cosines: wp.array[wp.float32],
    normals: wp.array[wp.vec3d],
    bad: wp.array[wp.int32],
) -> None:
    """Write the columns of `lidar.raycast.hits.Hits`, and the number of the first invalid ray to ``bad``."""
    i = _number(rays, wp.tid())
    beam = _ray(target, rays, i)
    if not _is_valid(beam):
        wp.atomic_min(bad, 0, i)
        return
    time = _time(rays, i)
    found = _first_hit(target, rays.near, _far(rays, i), rays.mask, beam, time, False)
    t = wp.float64(INF)
    cosine = wp.float64(0.0)
    face = wp.int32(-1)
    normal = wp.vec3d(ZERO, ZERO, ZERO)
    if found.row >= 0:
        part = found.row
        count = int(target.parts[part, COUNT])
        planes = wp.array(ptr=wp.uint64(target.parts[part, PLANES]), shape=(count,), dtype=Plane)
        plane = planes[found.prim]
        normal = plane.normal
        offset = plane.offset
        length = wp.float64(1.0)
        pose = Pose()
        if found.instance >= 0:
            # Normals transform by the cofactor matrix; a point of the plane is its offset times its normal.
            pose = _pose_of(target, found.instance, time)
            n = plane.normal
            normal = wp.vec3d(
                wp.dot(wp.cross(pose.y, pose.z), n),
                wp.dot(wp.cross(pose.z, pose.x), n),
                wp.dot(wp.cross(pose.x, pose.y), n),
            )
            p = n * plane.offset
            offset = (
                normal[0] * (wp.dot(pose.x, p) + pose.shift[0])
                + normal[1] * (wp.dot(pose.y, p) + pose.shift[1])
                + normal[2] * (wp.dot(pose.z, p) + pose.shift[2])
            )
            length = wp.sqrt(wp.dot(normal, normal))
        o = beam.start
        along = wp.dot(normal, beam.way)
        t = (offset - normal[0] * o[0] - normal[1] * o[1] - normal[2] * o[2]) / along
        squared = wp.dot(beam.way, beam.way)
        inverse = wp.float64(1.0)
        if not wp.abs(squared - ONE) < UNIT:
            inverse = ONE / wp.sqrt(squared)
        cosine = -along * inverse
        if found.instance >= 0:
            cosine = cosine / length
        if not wp.abs(cosine) >= GRAZING:
            corners = wp.array(ptr=wp.uint64(target.parts[part, CORNERS]), shape=(count,), dtype=wp.vec3i)
            vertices = wp.array(ptr=wp.uint64(target.parts[part, VERTICES]), shape=(count,), dtype=wp.vec3d)
            named = corners[found.prim]
            a = vertices[named[0]]
            b = vertices[named[1]]
            c = vertices[named[2]]
            if found.instance >= 0:
                a = _move(pose, a)
                b = _move(pose, b)
                c = _move(pose, c)
            t = _clip(t, beam, a - o, b - o, c - o)
            if cosine != cosine:  # noqa: PLR0124
                cosine = ZERO
        face = found.prim
        named_by = target.parts[part, NUMBERS]
        if named_by != wp.int64(0):
            numbers = wp.array(ptr=wp.uint64(named_by), shape=(count,), dtype=wp.int32)
            face = numbers[found.prim]
        face = face + int(target.parts[part, START_NUMBER])
    ranges[i] = t
    cosines[i] = wp.float32(cosine)
    faces[i] = face
    instances[i] = found.instance
    if normals.shape[0] > 0:
        length = wp.sqrt(wp.dot(normal, normal))
        scale = wp.float64(0.0)
        if length > ZERO:
            scale = ONE / length
        normals[i] = normal * scale


@wp.func
def _move(pose: Pose, p: wp.vec3d) -> wp.vec3d:
    return wp.vec3d(
        wp.dot(pose.x, p) + pose.shift[0],
        wp.dot(pose.y, p) + pose.shift[1],
        wp.dot(pose.z, p) + pose.shift[2],
    )


@wp.kernel
def test_occlusion(
    target: WarpTarget, rays: WarpRays, out: wp.array[wp.bool], bad: wp.array[wp.int32]
) -> None:
    """Write whether rays hit anything, and the number of the first invalid ray to ``bad``."""
    i = _number(rays, wp.tid())
    beam = _ray(target, rays, i)
    if _is_valid(beam):
        out[i] = _first_hit(target, rays.near, _far(rays, i), rays.mask, beam, _time(rays, i), True).row >= 0
    else:
        wp.atomic_min(bad, 0, i)
