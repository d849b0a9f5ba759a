"""Compiled recursion of `railfix.tracking.filter`: epochs in sequence, all hypotheses in parallel arrays.

`railfix.kernels.tracking.layout` defines the arrays and `railfix.kernels.tracking.index` their indices.
`railfix.kernels.tracking.recursion.advance` returns at an epoch that requires a position search, which is done between
the prediction and the update of the epoch.

Single letters are indices: t epoch, h hypothesis, b source and the sub-filter without it, j measurement, k channel or
term of a quantity, q quantity, i unknown, g clock, v vertex, c component x, y, z. Loops over the elements of a matrix
use the next free letters of a, b, c, i, j. The letters x, P, F, Q, H, T, z, y, S and g = P h are those of
docs/filter-equations.md, which has a table of further letters.
"""
