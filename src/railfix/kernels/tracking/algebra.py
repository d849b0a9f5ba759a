"""Inverses of small matrices, medians, and probabilities by their logarithms."""

from __future__ import annotations

import functools
import math
from typing import Any, Final, TypeAlias

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.layout import LANES

Pair: TypeAlias = tuple[int, int]
_SHORT: Final = ir.IntType(32)
_VECTOR: Final = ir.VectorType(ir.DoubleType(), LANES)


def _add_rows_plain(
    target: Floats, at: int, by: float, left: Floats, of: Pair, source: Floats, rows: tuple[int, int, int], width: int
) -> None:
    begin, stride, count = rows
    for k in range(count):
        row = slice(begin + k * stride, begin + k * stride + width)
        target.reshape(-1)[at : at + width] += by * left.reshape(-1)[of[0] + k * of[1]] * source.reshape(-1)[row]


@intrinsic
def _add_rows(
    _: Any, target: Any, at: Any, by: Any, left: Any, of: Any, source: Any, rows: Any, width: Any
) -> Any:
    """Sums of rows in vectors of the processor: of loops numba asks at each row whether arrays overlap."""
    del at, by, of, rows, width  # of these types
    pair, three = (types.UniTuple(types.intp, size) for size in (2, 3))
    signature = types.void(target, types.intp, types.float64, left, pair, source, three, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target, at, by, left, of, source, rows, width = (
            context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
            for kind, value in zip(signature.args, arguments, strict=True)
        )
        (first, step), (begin, stride, count) = (cgutils.unpack_tuple(builder, value) for value in (of, rows))
        number = width.type

        def vector_at(data: Any, start: Any, column: Any, k: int) -> Any:
            offset = builder.add(builder.add(start, column), number(k * LANES))
            return builder.bitcast(builder.gep(data, [offset]), _VECTOR.as_pointer())

        def add_columns(column: Any, vectors: int) -> None:
            # narrow rows are summed up in several parts, as each sum waits for the one before
            ways, none = 4 // vectors, _VECTOR([0.0] * LANES)
            totals = [[cgutils.alloca_once_value(builder, none) for _ in range(vectors)] for _ in range(ways)]
            for k, total in enumerate(totals[0]):
                builder.store(builder.load(vector_at(target, at, column, k), align=8), total)

            def add(row: Any, way: int) -> None:
                place = builder.add(first, builder.mul(row, step))
                scalar = builder.fmul(by, builder.load(builder.gep(left, [place])))
                single = builder.insert_element(_VECTOR(ir.Undefined), scalar, _SHORT(0))
                factor = builder.shuffle_vector(single, single, ir.VectorType(_SHORT, LANES)([0] * LANES))
                start = builder.add(begin, builder.mul(row, stride))
                for k, total in enumerate(totals[way]):
                    value = builder.load(vector_at(source, start, column, k), align=8)
                    product = builder.fmul(factor, value, flags=("contract",))
                    builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)

            together = builder.sub(count, builder.srem(count, number(ways)))
            with cgutils.for_range_slice(builder, number(0), together, number(ways), inc=True) as (row, _):
                for way in range(ways):
                    add(builder.add(row, number(way)), way)
            if ways > 1:
                with cgutils.for_range_slice(builder, together, count, number(1), inc=True) as (row, _):
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


#: ``target[at + c] += by sum over k of left[of[0] + of[1] k] source[begin + stride k + c]`` for `count` rows and the
#: columns below `width`, a number of whole vectors; all places are those in the flat arrays.
add_rows: Final[Any] = _add_rows_plain if numba.config.DISABLE_JIT else _add_rows  # type: ignore[attr-defined]


@borrowing
def whole_lanes(size: int) -> int:
    """Return a number of columns as whole vectors: rows of work space have room for them."""
    return (size + LANES - 1) // LANES * LANES


@borrowing
def factorise(matrix: Floats, m: int, size: int, factor: Floats) -> None:
    """Write the upper Cholesky factor U of a symmetric matrix, U' U = `matrix[m]`.

    Of `matrix[m]` the upper half is read; what `factor` has below is not defined.
    """
    width, end = factor.shape[1], whole_lanes(size)
    for i in range(size):
        first = i // LANES * LANES
        for j in range(first, end):
            factor[i, j] = matrix[m, i, j]
        add_rows(factor, i * width + first, -1.0, factor, (i, width), factor, (first, width, i), end - first)
        scale = 1.0 / math.sqrt(max(factor[i, i], 1e-300))
        for j in range(first, end):
            factor[i, j] *= scale


@borrowing
def log_determinant(factor: Floats, size: int) -> float:
    """Return log det of U' U."""
    total = 0.0
    for i in range(size):
        total += math.log(factor[i, i])
    return 2.0 * total


@borrowing
def solve_forward(factor: Floats, size: int, right: Floats) -> None:
    """Multiply `right` by U'^-1."""
    width = right.shape[1]
    for i in range(size):
        add_rows(right, i * width, -1.0, factor, (i, factor.shape[1]), right, (0, width, i), width)
        scale = 1.0 / factor[i, i]
        for j in range(width):
            right[i, j] *= scale


@borrowing
def invert_factor(factor: Floats, size: int, lower: Floats) -> None:
    """Write L, the inverse of U', into `lower`, whose upper half is 0: the inverse of U' U is L' L."""
    width = lower.shape[1]
    for k in range(size):
        end, scale = whole_lanes(k + 1), 1.0 / factor[k, k]
        for i in range(end):
            lower[k, i] = 0.0
        add_rows(lower, k * width, -scale, factor, (k, factor.shape[1]), lower, (0, width, k), end)
        lower[k, k] = scale


@borrowing
def square(lower: Floats, size: int, result: Floats, to: int) -> None:
    """Write L' L into `result[to]`."""
    width, end = lower.shape[1], whole_lanes(size)
    for i in range(size):
        for j in range(end):
            result[to, i, j] = 0.0
        at = (to * result.shape[1] + i) * result.shape[2]
        add_rows(result, at, 1.0, lower, (i * width + i, width), lower, (i * width, width, size - i), end)


@borrowing
def invert(matrix: Floats, m: int, size: int, factor: Floats, lower: Floats, result: Floats, to: int) -> None:
    """Write the inverse of a symmetric matrix into `result[to]`.

    Of `matrix[m]` the upper half is read; `factor` and `lower` are work space, the upper half of `lower` is 0.
    """
    factorise(matrix, m, size, factor)
    invert_factor(factor, size, lower)
    square(lower, size, result, to)


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
    """Median of values in rising order."""
    if size % 2:
        return float(ordered[size // 2])
    return float(0.5 * (ordered[size // 2 - 1] + ordered[size // 2]))


@borrowing
def median(values: Floats, h: int, first: int, size: int, ordered: Floats) -> float:
    """Median of a part of a row; `ordered` is work space."""
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
    """Logarithm of the sum of exponentials."""
    largest = values[0]
    for i in range(1, size):
        largest = max(largest, values[i])
    total = 0.0
    for i in range(size):
        total += math.exp(values[i] - largest)
    return float(largest + math.log(total))
