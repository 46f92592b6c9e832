"""Arithmetic on all lanes of a packet as explicit vector instructions.

A packet is a sequence of float64 rows with one number per lane; `lidar.raycast.rows` names the rows. The
compiler does not vectorise loops over lanes reliably. Each function takes a tuple with an item per lane:
its length is a compile-time constant.
"""

from __future__ import annotations

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


def _row(kind: Any, kept: Any) -> Any:
    @intrinsic
    def move(context: Any, lanes: Any, source: Any, target: Any) -> Any:  # noqa: ARG001
        def build(made: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
            _Rows(builder, lanes, address=values[2], kind=kept)[0] = _Rows(
                builder, lanes, address=values[1], kind=kind
            )[0]
            return made.get_dummy_value()

        return types.void(lanes, types.int64, types.int64), build

    return move


move_float64 = _row(_DOUBLE, _DOUBLE)
move_int32 = _row(_INT, _INT)
narrow = _row(_DOUBLE, _FLOAT)
"""Copy a row from one address to another; `narrow` rounds to float32."""


@intrinsic
def _same(context: Any, lanes: Any, source: Any) -> Any:  # noqa: ARG001
    def build(made: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
        row = _Rows(builder, lanes, address=values[1], kind=_INT)[0].value
        first = builder.extract_element(row, ir.Constant(_INT, 0))
        differ = builder.icmp_unsigned(
            "!=", row, _Rows(builder, lanes, address=values[1], kind=_INT).same(first).value
        )
        bits = ir.IntType(lanes.count)
        return builder.icmp_unsigned("==", builder.bitcast(differ, bits), ir.Constant(bits, 0))

    return types.boolean(lanes, types.int64), build


same: Any = _same
"""Whether all 32-bit numbers of a row are the same."""


@intrinsic
def _settle(
    context: Any,  # noqa: ARG001
    lanes: Any,
    work: Any,  # noqa: ARG001
    packet: Any,  # noqa: ARG001
    x: Any,  # noqa: ARG001
    y: Any,  # noqa: ARG001
    z: Any,  # noqa: ARG001
    near: Any,  # noqa: ARG001
) -> Any:
    def build(made: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
        rows, rounded = (
            _Rows(builder, lanes, address=values[1]),
            _Rows(builder, lanes, address=values[2], kind=_FLOAT),
        )
        place = [rows[r] - rows.same(value) for r, value in enumerate(values[3:6])]
        way = [rows[DX + r] for r in range(3)]
        for r in range(3):
            rows[r] = rounded[r] = place[r]
            rounded[RAY_DX + r] = way[r]
        rows[INVERSE] = rows.same(1.0)
        rounded[RAY_NEAR], rounded[RAY_TIME] = rows.same(values[6]), rows[TIME]
        rounded[RAY_FAR] = rows[FAR] * rows.same(UP)
        squared = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
        near = (abs(place[0]) + abs(place[1]) + abs(place[2])).all("<", rows.same(HUGE))
        unit = abs(squared - rows.same(1.0)).all("<", rows.same(UNIT))
        return builder.and_(near, unit)

    return types.boolean(lanes, types.int64, types.int64, *[types.float64] * 4), build


settle: Any = _settle
"""Make origins relative to a point; write the rays to Embree's packet in float32, with far rounded up.

Returns whether all directions have length 1 and all origins are below `HUGE`."""


@intrinsic
def _look_up(context: Any, lanes: Any, planes: Any, size: Any, faces: Any, work: Any) -> Any:  # noqa: ARG001
    def build(made: Any, builder: Any, signature: Any, values: Any) -> Any:
        start, size, faces, work = values[1:]
        rows, long = _Rows(builder, lanes, address=work), ir.IntType(64)
        places = _Rows(builder, lanes, address=faces, kind=_INT)[0].value
        four, margin, packed = ir.VectorType(_DOUBLE, 4), ir.Constant(rows.kind, ir.Undefined), []
        for k in range(lanes.count):
            lane = ir.Constant(_INT, k)
            face = builder.zext(builder.extract_element(places, lane), long)
            place = builder.add(start, builder.mul(face, size))
            packed.append(builder.load(builder.inttoptr(place, four.as_pointer()), align=8))
            last = builder.inttoptr(builder.add(place, long(32)), _DOUBLE.as_pointer())
            margin = builder.insert_element(margin, builder.load(last), lane)
        while len(packed) > 1:
            count = 2 * packed[0].type.count
            every = ir.Constant(ir.VectorType(_INT, count), list(range(count)))
            pairs = zip(packed[::2], packed[1::2], strict=True)
            packed = [builder.shuffle_vector(one, other, every) for one, other in pairs]
        for r, row in enumerate((NX, NY, NZ, OFFSET)):
            column = ir.Constant(ir.VectorType(_INT, lanes.count), list(range(r, 4 * lanes.count, 4)))
            rows[row] = _Row(builder, builder.shuffle_vector(packed[0], packed[0], column))
        rows[MARGIN] = _Row(builder, margin)
        return made.get_constant(signature.return_type, 0)

    return types.int64(lanes, *[types.int64] * 4), build


look_up: Any = _look_up
"""Write the planes of a row of faces, from a table at an address with a size in bytes of its rows.

Rows written lane by lane could not be read as vectors at once: the processor would wait for the writes."""


@intrinsic
def _cross(context: Any, lanes: Any, work: Any, packet: Any, near: Any) -> Any:  # noqa: ARG001
    def build(made: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
        rows = _Rows(builder, lanes, address=values[1])
        hits = _Rows(builder, lanes, address=values[2], kind=_FLOAT)
        ox, oy, oz, dx, dy, dz = (rows[r] for r in (OX, OY, OZ, DX, DY, DZ))
        nx, ny, nz, d = (rows[r] for r in (NX, NY, NZ, OFFSET))
        along = nx * dx + ny * dy + nz * dz
        t = (d - nx * ox - ny * oy - nz * oz) / along
        cosine = -along * rows[SCALE]
        rows[RANGE], rows[COSINE] = t, cosine
        u, v, margin = hits[HIT_U].double(), hits[HIT_V].double(), rows[MARGIN]
        settled = builder.and_(cosine.all(">=", rows.same(GRAZING)), t.all("<=", rows[FAR]))
        started = ((t - rows.same(values[3])) * cosine).all(">", rows.same(START) * rows[INVERSE])
        settled = builder.and_(settled, started)
        for share in (u, v, rows.same(1.0) - u - v):
            settled = builder.and_(settled, (share * cosine).all(">=", margin))
        return settled

    return types.boolean(lanes, types.int64, types.int64, types.float64), build


cross: Any = _cross
"""Compute the ranges and cosines at which rays intersect their planes.

Returns whether all ranges are beyond near and within far, and all rays hit the front of a face, at no grazing
angle and clearly within its edges."""
