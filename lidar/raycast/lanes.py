"""Arithmetic on all lanes of a packet as explicit vector instructions.

A packet is a sequence of float64 rows with one number per lane; `lidar.raycast.rows` names the rows. The
compiler does not vectorise loops over lanes reliably. Each function takes a tuple with an item per lane:
its length is a compile-time constant.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from lidar.raycast.rows import (
    COSINE,
    DX,
    DY,
    DZ,
    FAR,
    HIT_U,
    HIT_V,
    INVERSE,
    MARGIN,
    NX,
    NY,
    NZ,
    OFFSET,
    OX,
    OY,
    OZ,
    RANGE,
    RAY_DX,
    RAY_FAR,
    RAY_NEAR,
    RAY_TIME,
    SCALE,
    TIME,
)

GRAZING = 1e-3
"""Cosine below which a range is clipped to the face's extent along the ray."""
HUGE = 1e100
"""Rays with squared lengths or coordinates from this on are invalid."""
UNIT = 1e-12
"""Tolerance of the squared length of a unit vector."""
START = 1e-9
"""Metres between the start of a ray and the plane of a face up to which the ray starts on the face."""
UP = 1.0 + 2.0**-23
"""Factor that compensates rounding down to float32."""

_DOUBLE, _FLOAT, _INT = ir.DoubleType(), ir.FloatType(), ir.IntType(32)


class _Row:
    """A row of numbers in generated code."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def __add__(self, other: _Row) -> _Row:
        return _Row(self.builder, self.builder.fadd(self.value, other.value))

    def __sub__(self, other: _Row) -> _Row:
        return _Row(self.builder, self.builder.fsub(self.value, other.value))

    def __mul__(self, other: _Row) -> _Row:
        return _Row(self.builder, self.builder.fmul(self.value, other.value))

    def __truediv__(self, other: _Row) -> _Row:
        return _Row(self.builder, self.builder.fdiv(self.value, other.value))

    def __neg__(self) -> _Row:
        return _Row(self.builder, self.builder.fneg(self.value))

    def __abs__(self) -> _Row:
        row = self.value.type
        function = self.builder.module.declare_intrinsic(
            f"llvm.fabs.v{row.count}f64", (), ir.FunctionType(row, [row])
        )
        return _Row(self.builder, self.builder.call(function, [self.value]))

    def root(self) -> _Row:
        """Square roots."""
        row = self.value.type
        function = self.builder.module.declare_intrinsic(
            f"llvm.sqrt.v{row.count}f64", (), ir.FunctionType(row, [row])
        )
        return _Row(self.builder, self.builder.call(function, [self.value]))

    def least(self, *others: _Row) -> Any:
        """Lanes in which no other row has a smaller number."""
        flags = [self.builder.fcmp_ordered("<=", self.value, other.value) for other in others]
        return functools.reduce(self.builder.and_, flags)

    def double(self) -> _Row:
        """The numbers as float64."""
        return _Row(
            self.builder, self.builder.fpext(self.value, ir.VectorType(_DOUBLE, self.value.type.count))
        )

    def all(self, relation: str, other: _Row) -> Any:
        """Whether the relation holds in every lane; false if a number is NaN."""
        flags = self.builder.fcmp_ordered(relation, self.value, other.value)
        bits = ir.IntType(flags.type.count)
        whole = ir.Constant(bits, 2**flags.type.count - 1)
        return self.builder.icmp_unsigned("==", self.builder.bitcast(flags, bits), whole)


class _Rows:
    """Contiguous rows of numbers at an address in generated code."""

    def __init__(self, builder: Any, lanes: Any, *, address: Any, kind: Any = _DOUBLE) -> None:
        self.builder, self.lanes, self.kind = builder, lanes.count, ir.VectorType(kind, lanes.count)
        self.size = 4 if kind in (_FLOAT, _INT) else 8
        self.base = builder.inttoptr(address, self.kind.as_pointer())

    def _place(self, row: int) -> Any:
        return self.builder.gep(self.base, [ir.Constant(ir.IntType(64), row)])

    def __getitem__(self, row: int) -> _Row:
        return _Row(self.builder, self.builder.load(self._place(row), align=self.size))

    def __setitem__(self, row: int, numbers: _Row) -> None:
        value = numbers.value
        if value.type != self.kind:
            value = self.builder.fptrunc(value, self.kind)
        self.builder.store(value, self._place(row), align=self.size)

    def same(self, number: Any) -> _Row:
        """A row filled with one number, a constant or a value of the generated code."""
        if isinstance(number, float):
            return _Row(self.builder, ir.Constant(self.kind, [number] * self.lanes))
        one = self.builder.insert_element(ir.Constant(self.kind, ir.Undefined), number, ir.Constant(_INT, 0))
        every = ir.Constant(ir.VectorType(_INT, self.lanes), [0] * self.lanes)
        return _Row(self.builder, self.builder.shuffle_vector(one, one, every))


_PLACE, _NUMBER = types.int64, types.float64


def _compile_function(returned: Any, *kinds: Any) -> Callable[[Callable[..., Any]], Any]:
    """Make a function for compiled code of one that generates its instructions.

    The generator takes the builder, the type of the lanes and the values of the arguments, and returns that
    of the result, None for none. The function takes the lanes and the arguments, which are of these kinds.
    """

    def decorated(generate: Callable[..., Any]) -> Any:
        def typed(context: Any, lanes: Any, *arguments: Any) -> Any:  # noqa: ARG001
            def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
                result = generate(builder, lanes, *values[1:])
                return target.get_dummy_value() if result is None else result

            return returned(lanes, *kinds), build

        named: Any = typed  # numba looks for the arguments' names; the builder stands for the context
        named.__signature__ = inspect.signature(generate)
        return intrinsic(named)

    return decorated


def _row(kind: Any, kept: Any) -> Any:
    @_compile_function(types.void, _PLACE, _PLACE)
    def move(builder: Any, lanes: Any, source: Any, target: Any) -> None:
        row = _Rows(builder, lanes, address=source, kind=kind)[0]
        _Rows(builder, lanes, address=target, kind=kept)[0] = row

    return move


move_float64 = _row(_DOUBLE, _DOUBLE)
move_int32 = _row(_INT, _INT)
narrow = _row(_DOUBLE, _FLOAT)
"""Copy a row from one address to another; `narrow` rounds to float32."""


def _hit(builder: Any, lanes: Any, geometry: Any) -> Any:
    """Lanes that hit a geometry, from a row at an address."""
    row = _Rows(builder, lanes, address=geometry, kind=_INT)[0].value
    return builder.icmp_unsigned("!=", row, ir.Constant(row.type, [-1] * lanes.count))


@_compile_function(types.void, _NUMBER, _PLACE)
def fill(builder: Any, lanes: Any, number: Any, target: Any) -> None:
    """Write one number to all lanes of a row."""
    row = _Rows(builder, lanes, address=target)
    row[0] = row.same(number)


@_compile_function(types.int64, _PLACE)
def hits(builder: Any, lanes: Any, geometry: Any) -> Any:
    """A bit for each lane that hit a geometry of a row at an address."""
    flags = builder.bitcast(_hit(builder, lanes, geometry), ir.IntType(lanes.count))
    return builder.zext(flags, ir.IntType(64))


@_compile_function(types.int64, _PLACE)
def sole(builder: Any, lanes: Any, geometry: Any) -> Any:
    """The geometry that all lanes of a row that hit one have hit; -1 if there are several."""
    rows = _Rows(builder, lanes, address=geometry, kind=_INT)
    row, bits = rows[0].value, ir.IntType(lanes.count)
    reduce = builder.module.declare_intrinsic(
        f"llvm.vector.reduce.umin.v{lanes.count}i32", (), ir.FunctionType(_INT, [row.type])
    )
    least = builder.call(reduce, [row])
    other = builder.icmp_unsigned("!=", row, rows.same(least).value)
    differ = builder.bitcast(builder.and_(other, _hit(builder, lanes, geometry)), bits)
    found = builder.icmp_unsigned("==", differ, ir.Constant(bits, 0))
    return builder.select(found, builder.zext(least, ir.IntType(64)), ir.IntType(64)(-1))


@_compile_function(types.boolean, _PLACE, _PLACE, _NUMBER, _NUMBER, _NUMBER, _NUMBER)
def settle(builder: Any, lanes: Any, work: Any, packet: Any, x: Any, y: Any, z: Any, near: Any) -> Any:
    """Make origins relative to a point; write the rays to Embree's packet in float32, with far rounded up.

    Returns whether all directions have length 1 and all origins are below `HUGE`.
    """
    rows = _Rows(builder, lanes, address=work)
    rounded = _Rows(builder, lanes, address=packet, kind=_FLOAT)
    place = [rows[r] - rows.same(value) for r, value in enumerate((x, y, z))]
    way = [rows[DX + r] for r in range(3)]
    for r in range(3):
        rows[r] = rounded[r] = place[r]
        rounded[RAY_DX + r] = way[r]
    rows[INVERSE] = rows.same(1.0)
    rounded[RAY_NEAR], rounded[RAY_TIME] = rows.same(near), rows[TIME]
    rounded[RAY_FAR] = rows[FAR] * rows.same(UP)
    squared = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
    close = (abs(place[0]) + abs(place[1]) + abs(place[2])).all("<", rows.same(HUGE))
    straight = abs(squared - rows.same(1.0)).all("<", rows.same(UNIT))
    return builder.and_(close, straight)


@_compile_function(types.boolean, _PLACE, _PLACE)
def shorten(builder: Any, lanes: Any, work: Any, packet: Any) -> Any:
    """Write unit directions to Embree's packet for rays of any length, after `settle`.

    Returns whether all directions and origins are valid.
    """
    rows = _Rows(builder, lanes, address=work)
    rounded = _Rows(builder, lanes, address=packet, kind=_FLOAT)
    ox, oy, oz, x, y, z = (rows[r] for r in (OX, OY, OZ, DX, DY, DZ))
    squared = x * x + y * y + z * z
    length = squared.root()
    inverse = rows.same(1.0) / length
    rows[INVERSE] = inverse
    for r, way in enumerate((x, y, z)):
        rounded[RAY_DX + r] = way * inverse
    rounded[RAY_NEAR] = rounded[RAY_NEAR].double() * length
    rounded[RAY_FAR] = rows[FAR] * length * rows.same(UP)
    near = (abs(ox) + abs(oy) + abs(oz)).all("<", rows.same(HUGE))
    finite = builder.and_(squared.all(">", rows.same(0.0)), squared.all("<", rows.same(HUGE)))
    return builder.and_(near, finite)


@_compile_function(types.void, _PLACE, _PLACE, _NUMBER)
def nudge(builder: Any, lanes: Any, work: Any, packet: Any, angle: Any) -> None:
    """Turn the directions of Embree's packet by an angle, radians, and set far again."""
    rows = _Rows(builder, lanes, address=work)
    rounded = _Rows(builder, lanes, address=packet, kind=_FLOAT)
    inverse, turned = rows[INVERSE], rows.same(angle)
    x, y, z = (rows[r] * inverse for r in (DX, DY, DZ))
    least_x, least_y = abs(x).least(abs(y), abs(z)), abs(y).least(abs(z))
    least_y = builder.and_(builder.not_(least_x), least_y)
    least_z = builder.not_(builder.or_(least_x, least_y))
    for r, (way, least) in enumerate(((x, least_x), (y, least_y), (z, least_z))):
        rounded[RAY_DX + r] = _Row(builder, builder.select(least, (way + turned).value, way.value))
    rounded[RAY_FAR] = rows[FAR] / inverse * rows.same(UP)


def _vectors(builder: Any, column: Any, stride: Any, rows: list[Any]) -> list[Any]:
    """The first three numbers of rows of a float64 column at an address, and a fourth that means nothing."""
    three = ir.VectorType(_DOUBLE, 3)
    widened = ir.Constant(ir.VectorType(_INT, 4), [0, 1, 2, 2])
    out = []
    for row in rows:
        place = builder.inttoptr(builder.add(column, builder.mul(row, stride)), three.as_pointer())
        vector = builder.load(place, align=8)
        out.append(builder.shuffle_vector(vector, vector, widened))
    return out


def _columns(builder: Any, vectors: list[Any], count: int) -> list[_Row]:
    """The four rows of numbers of ``count`` lanes whose vectors of four are given, one a lane.

    Fours of lanes are transposed by the pairs of shuffles that processors have.
    """

    def shuffled(one: Any, other: Any, *lanes: int) -> Any:
        return builder.shuffle_vector(one, other, ir.Constant(ir.VectorType(_INT, len(lanes)), lanes))

    padded = vectors + vectors[-1:] * (-len(vectors) % 4)
    parts: list[list[Any]] = [[], [], [], []]
    for k in range(0, len(padded), 4):
        a, b, c, d = padded[k : k + 4]
        low = shuffled(a, b, 0, 4, 2, 6), shuffled(c, d, 0, 4, 2, 6)
        high = shuffled(a, b, 1, 5, 3, 7), shuffled(c, d, 1, 5, 3, 7)
        for r, (one, other) in enumerate((low, high, low, high)):
            first = 2 * (r // 2)
            parts[r].append(shuffled(one, other, first, first + 1, first + 4, first + 5))
    rows = []
    for column in parts:
        while len(column) > 1:
            n = 2 * column[0].type.count
            pairs = zip(column[::2], column[1::2], strict=True)
            column = [shuffled(one, other, *range(n)) for one, other in pairs]  # noqa: PLW2901
        rows.append(_Row(builder, shuffled(column[0], column[0], *range(count))))
    return rows


def _numbers(builder: Any, lanes: Any, column: Any) -> list[Any]:
    """The int64 numbers of the lanes of a row at an address."""
    base = builder.inttoptr(column, ir.IntType(64).as_pointer())
    return [builder.load(builder.gep(base, [ir.Constant(_INT, k)])) for k in range(lanes.count)]


@_compile_function(types.void, _PLACE, _PLACE, _PLACE, _PLACE)
def spread(builder: Any, lanes: Any, ids: Any, column: Any, stride: Any, target: Any) -> None:
    """Write three rows, at an address, of the vectors of a column with a stride in bytes."""
    vectors = _vectors(builder, column, stride, _numbers(builder, lanes, ids))
    rows = _Rows(builder, lanes, address=target)
    for r, row in enumerate(_columns(builder, vectors, lanes.count)[:3]):
        rows[r] = row


def _turning(*, placed: bool) -> Any:
    """`turn` if the places of poses are the first rows of work, else `shift`."""

    @_compile_function(types.void, *[_PLACE] * 7)
    def turn(
        builder: Any,
        lanes: Any,
        ids: Any,
        column: Any,
        stride: Any,
        pose: Any,
        position: Any,
        matrix: Any,
        work: Any,
    ) -> None:
        numbers = _numbers(builder, lanes, ids)
        long, rows = ir.IntType(64), _Rows(builder, lanes, address=work)
        poses = [
            builder.load(builder.gep(builder.inttoptr(pose, long.as_pointer()), [number]))
            for number in numbers
        ]
        vectors = _vectors(builder, column, stride, numbers)

        def write(turned: list[_Row], places: list[_Row]) -> None:
            for r in range(3):
                if placed:
                    rows[OX + r], rows[DX + r] = places[r], turned[r]
                else:
                    rows[OX + r] = rows[OX + r] + turned[r]

        def shared(table: Any, count: int) -> list[_Row]:
            """The numbers of the one pose of all lanes in a table of ``count`` a pose."""
            start = builder.add(table, builder.mul(poses[0], long(8 * count)))
            first = builder.inttoptr(start, _DOUBLE.as_pointer())
            return [rows.same(builder.load(builder.gep(first, [long(e)]))) for e in range(count)]

        differ = functools.reduce(builder.or_, [builder.xor(poses[0], other) for other in poses[1:]], long(0))
        with builder.if_else(builder.icmp_unsigned("==", differ, long(0))) as (alike, mixed):
            with alike:
                m = shared(matrix, 9)
                x, y, z, _ = _columns(builder, vectors, lanes.count)
                turned = [m[r] * x + m[r + 1] * y + m[r + 2] * z for r in (0, 3, 6)]
                write(turned, shared(position, 3))
            with mixed:
                turned = _by_lane(builder, vectors, matrix, poses)
                places = _vectors(builder, position, long(24), poses)
                write(turned, _columns(builder, places, lanes.count)[:3])

    return turn


def _by_lane(builder: Any, vectors: list[Any], matrix: Any, poses: list[Any]) -> list[_Row]:
    """The rows of vectors, one a lane, turned by the matrices of the lanes' poses."""
    four, long = ir.VectorType(_DOUBLE, 4), ir.IntType(64)
    products: list[list[Any]] = [[], [], []]
    for vector, pose in zip(vectors, poses, strict=True):
        start = builder.add(matrix, builder.mul(pose, long(72)))
        # The last row is read with a number before it, for the one after it may be beyond the table.
        late = builder.shuffle_vector(vector, vector, ir.Constant(ir.VectorType(_INT, 4), [0, 0, 1, 2]))
        for r, (offset, factor) in enumerate(((0, vector), (24, vector), (40, late))):
            place = builder.inttoptr(builder.add(start, long(offset)), four.as_pointer())
            products[r].append(builder.fmul(builder.load(place, align=8), factor))
    turned = []
    for r, product in enumerate(products):
        columns = _columns(builder, product, len(vectors))
        x, y, z = columns[1:] if r == 2 else columns[:3]
        turned.append(x + y + z)
    return turned


turn, shift = _turning(placed=True), _turning(placed=False)
"""Turn the vectors of a column, with a stride in bytes, by the matrices of their poses.

`turn` writes them as directions, and the positions of the poses as origins; `shift` adds them to the origins.
"""


@_compile_function(types.void, *[_PLACE] * 5)
def look_up(builder: Any, lanes: Any, planes: Any, size: Any, faces: Any, geometry: Any, work: Any) -> None:
    """Write the planes of a row of faces, from a table at an address with a size in bytes of its rows.

    A lane without a geometry gets the first plane.

    Rows written lane by lane could not be read as vectors at once: the processor would wait for the writes.
    """
    rows, long = _Rows(builder, lanes, address=work), ir.IntType(64)
    places = _Rows(builder, lanes, address=faces, kind=_INT)[0].value
    hit = _hit(builder, lanes, geometry)
    places = builder.select(hit, places, ir.Constant(places.type, [0] * lanes.count))
    four, margin, packed = ir.VectorType(_DOUBLE, 4), ir.Constant(rows.kind, ir.Undefined), []
    for k in range(lanes.count):
        lane = ir.Constant(_INT, k)
        face = builder.zext(builder.extract_element(places, lane), long)
        place = builder.add(planes, builder.mul(face, size))
        packed.append(builder.load(builder.inttoptr(place, four.as_pointer()), align=8))
        last = builder.inttoptr(builder.add(place, long(32)), _DOUBLE.as_pointer())
        margin = builder.insert_element(margin, builder.load(last), lane)
    for r, row in zip((NX, NY, NZ, OFFSET), _columns(builder, packed, lanes.count), strict=True):
        rows[r] = row
    rows[MARGIN] = _Row(builder, margin)


@_compile_function(types.void, _PLACE)
def unit(builder: Any, lanes: Any, work: Any) -> None:
    """Make the normals unit vectors; zero stays zero."""
    rows = _Rows(builder, lanes, address=work)
    x, y, z = rows[NX], rows[NY], rows[NZ]
    length, zero = (x * x + y * y + z * z).root(), rows.same(0.0)
    long = builder.fcmp_ordered(">", length.value, zero.value)
    scale = _Row(builder, builder.select(long, (rows.same(1.0) / length).value, zero.value))
    rows[NX], rows[NY], rows[NZ] = scale * x, scale * y, scale * z


@_compile_function(types.boolean, _PLACE, _PLACE, _NUMBER)
def cross(builder: Any, lanes: Any, work: Any, packet: Any, near: Any) -> Any:
    """Compute the ranges and cosines at which rays intersect their planes.

    Returns whether all ranges are beyond near and within far, and all rays hit the front of a face, at no
    grazing angle and clearly within its edges.
    """
    rows = _Rows(builder, lanes, address=work)
    shares = _Rows(builder, lanes, address=packet, kind=_FLOAT)
    ox, oy, oz, dx, dy, dz = (rows[r] for r in (OX, OY, OZ, DX, DY, DZ))
    nx, ny, nz, d = (rows[r] for r in (NX, NY, NZ, OFFSET))
    along = nx * dx + ny * dy + nz * dz
    t = (d - nx * ox - ny * oy - nz * oz) / along
    cosine = -along * rows[SCALE]
    rows[RANGE], rows[COSINE] = t, cosine
    u, v, margin = shares[HIT_U].double(), shares[HIT_V].double(), rows[MARGIN]
    settled = builder.and_(cosine.all(">=", rows.same(GRAZING)), t.all("<=", rows[FAR]))
    started = ((t - rows.same(near)) * cosine).all(">", rows.same(START) * rows[INVERSE])
    settled = builder.and_(settled, started)
    for share in (u, v, rows.same(1.0) - u - v):
        settled = builder.and_(settled, (share * cosine).all(">=", margin))
    return settled
