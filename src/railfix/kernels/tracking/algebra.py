"""Inverses of small matrices, medians, and probabilities by their logarithms."""

from __future__ import annotations

import functools
import math
from typing import Any, Final

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing, is_plain
from railfix.kernels.tracking.layout import LANES

_SHORT: Final = ir.IntType(32)
_VECTOR: Final = ir.VectorType(ir.DoubleType(), LANES)


def _add_rows_plain(
    target: Floats,
    origin: Floats,
    by: Floats,
    left: Floats,
    source: Floats,
    places: tuple[int, int, int, int, int],
    rows: tuple[int, int, int, int, int],
) -> None:
    (at, start, scale, first, begin), (step, stride, low, high, width) = places, rows
    total = origin.reshape(-1)[start : start + width].copy()
    for k in range(low, high):
        row = begin + k * stride
        share = by.reshape(-1)[scale + k] * left.reshape(-1)[first + k * step]
        total += share * source.reshape(-1)[row : row + width]
    target.reshape(-1)[at : at + width] = total


@intrinsic
def _add_rows(_: Any, target: Any, origin: Any, by: Any, left: Any, source: Any, places: Any, rows: Any) -> Any:
    """Return the sums of rows in vectors of the processor: of loops numba asks at each row whether arrays overlap."""
    del places, rows  # of these types
    five = types.UniTuple(types.intp, 5)  # type: ignore[no-untyped-call]
    signature = types.void(target, origin, by, left, source, five, five)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target, origin, by, left, source = (
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(signature.args[:5], arguments[:5], strict=True)
        )
        at, start, scale, first, begin = cgutils.unpack_tuple(builder, arguments[5])  # type: ignore[no-untyped-call]
        step, stride, low, high, width = cgutils.unpack_tuple(builder, arguments[6])  # type: ignore[no-untyped-call]
        number = width.type

        def vector_at(data: Any, place: Any, column: Any, k: int) -> Any:
            offset = builder.add(builder.add(place, column), number(k * LANES))
            return builder.bitcast(builder.gep(data, [offset]), _VECTOR.as_pointer())

        def add_columns(column: Any, vectors: int) -> None:
            # narrow rows are summed up in several parts, as each sum waits for the one before
            ways, none = 4 // vectors, _VECTOR([0.0] * LANES)
            totals = [
                [cgutils.alloca_once_value(builder, none) for _ in range(vectors)]  # type: ignore[no-untyped-call]
                for _ in range(ways)
            ]
            for k, total in enumerate(totals[0]):
                builder.store(builder.load(vector_at(origin, start, column, k), align=8), total)

            def add(row: Any, way: int) -> None:
                place = builder.add(first, builder.mul(row, step))
                share = builder.load(builder.gep(by, [builder.add(scale, row)]))
                share = builder.fmul(share, builder.load(builder.gep(left, [place])))
                single = builder.insert_element(_VECTOR(ir.Undefined), share, _SHORT(0))
                factor = builder.shuffle_vector(single, single, ir.VectorType(_SHORT, LANES)([0] * LANES))
                place = builder.add(begin, builder.mul(row, stride))
                for k, total in enumerate(totals[way]):
                    value = builder.load(vector_at(source, place, column, k), align=8)
                    product = builder.fmul(factor, value, flags=("contract",))
                    builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)

            together = builder.sub(high, builder.srem(builder.sub(high, low), number(ways)))
            with cgutils.for_range_slice(builder, low, together, number(ways), inc=True) as (row, _):
                for way in range(ways):
                    add(builder.add(row, number(way)), way)
            if ways > 1:
                with cgutils.for_range_slice(builder, together, high, number(1), inc=True) as (row, _):
                    add(row, 0)
            for k in range(vectors):
                total = functools.reduce(builder.fadd, [builder.load(parts[k]) for parts in totals])
                builder.store(total, vector_at(target, at, column, k), align=8)

        begun = number(0)
        for vectors in (4, 2, 1):
            columns = number(vectors * LANES)
            end = builder.sub(width, builder.srem(width, columns))
            with cgutils.for_range_slice(builder, begun, end, columns, inc=True) as (column, _):
                add_columns(column, vectors)
            begun = end
        return context.get_dummy_value()

    return signature, generate


#: Write ``origin[start + c] + sum over k of by[scale + k] left[first + step k] source[begin + stride k + c]`` into
#: ``target[at + c]`` for rows from `low` to below `high` and the columns below `width`, a number of whole vectors. All
#: places are those in the flat arrays.
add_rows: Final[Any] = _add_rows_plain if is_plain() else _add_rows


@borrowing
def whole_lanes(size: int) -> int:
    """Return a number of columns as whole vectors: rows of work space have room for them."""
    return (size + LANES - 1) // LANES * LANES


@borrowing
def factorise(matrix: Floats, m: int, size: int, factor: Floats, pivots: Floats) -> None:
    """Write the factor R of a symmetric matrix, R' D^-1 R = `matrix[m]`, an upper triangle with the diagonal D.

    Of `matrix[m]` the upper half is read; what `factor` has below is not defined. `pivots` gets D^-1 and -D^-1.
    """
    width, end = factor.shape[1], whole_lanes(size)
    for i in range(size):
        first = i // LANES * LANES
        at = (m * matrix.shape[1] + i) * matrix.shape[2]
        places = i * width + first, at + first, pivots.shape[1], i, first
        add_rows(factor, matrix, pivots, factor, factor, places, (width, width, 0, i, end - first))
        pivots[0, i] = 1.0 / max(factor[i, i], 1e-300)
        pivots[1, i] = -pivots[0, i]


@borrowing
def log_determinant(pivots: Floats, size: int) -> float:
    """Return log det of a factorised matrix."""
    total = 0.0
    for i in range(size):
        total -= math.log(pivots[0, i])
    return total


@borrowing
def solve_forward(factor: Floats, size: int, pivots: Floats, right: Floats) -> None:
    """Multiply `right` by the inverse of R' D^-1."""
    width = right.shape[1]
    for i in range(size):
        places = i * width, i * width, pivots.shape[1], i, 0
        add_rows(right, right, pivots, factor, right, places, (factor.shape[1], width, 0, i, width))


@borrowing
def invert_factor(factor: Floats, size: int, pivots: Floats, lower: Floats) -> None:
    """Write L, the inverse of R' D^-1: the inverse of the matrix is L' D^-1 L.

    `lower` is a lower triangle with ones on the diagonal, zeros above it, and these again behind its last row.
    """
    width, ones = lower.shape[1], lower.shape[1] ** 2
    for k in range(size):
        places = k * width, ones + k * width, pivots.shape[1], k, 0
        add_rows(lower, lower, pivots, factor, lower, places, (factor.shape[1], width, 0, k, whole_lanes(k + 1)))


@borrowing
def square(lower: Floats, size: int, pivots: Floats, result: Floats, to: int) -> None:
    """Write the inverse L' D^-1 L into `result[to]`."""
    width, end, none = lower.shape[1], whole_lanes(size), (lower.shape[0] - 1) * lower.shape[1]
    for i in range(size):
        places = (to * result.shape[1] + i) * result.shape[2], none, 0, i, 0
        add_rows(result, lower, pivots, lower, lower, places, (width, width, i, size, end))


@borrowing
def invert(
    matrix: Floats, m: int, size: int, factor: Floats, pivots: Floats, lower: Floats, result: Floats, to: int
) -> None:
    """Write the inverse of a symmetric matrix into `result[to]`; the other arrays are work space (`invert_factor`)."""
    factorise(matrix, m, size, factor, pivots)
    invert_factor(factor, size, pivots, lower)
    square(lower, size, pivots, result, to)


@borrowing
def insert(ordered: Floats, size: int, value: float) -> None:
    """Insert a value among `size` others in rising order."""
    j = size
    while j > 0 and ordered[j - 1] > value:
        ordered[j] = ordered[j - 1]
        j -= 1
    ordered[j] = value


@borrowing
def middle(ordered: Floats, size: int) -> float:
    """Return the median of values in rising order."""
    if size % 2:
        return float(ordered[size // 2])
    return float(0.5 * (ordered[size // 2 - 1] + ordered[size // 2]))


@borrowing
def median(values: Floats, h: int, first: int, size: int, ordered: Floats) -> float:
    """Return the median of a part of a row; `ordered` is work space."""
    for i in range(size):
        insert(ordered, i, values[h, first + i])
    return middle(ordered, size)


@borrowing
def restart(spread: Floats, unknown: int, variance: float, h: int) -> None:
    """Make an unknown independent of all else."""
    for c in range(spread.shape[1]):
        spread[h, unknown, c] = 0.0
        spread[h, c, unknown] = 0.0
    spread[h, unknown, unknown] = variance


@borrowing
def log_sum(values: Floats, size: int) -> float:
    """Return the logarithm of the sum of exponentials."""
    largest = values[0]
    for i in range(1, size):
        largest = max(largest, values[i])
    total = 0.0
    for i in range(size):
        total += math.exp(values[i] - largest)
    return float(largest + math.log(total))
