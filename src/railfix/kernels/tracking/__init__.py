"""Compiled recursion of `railfix.tracking.filter`: epochs in sequence, all hypotheses in parallel arrays.

`railfix.kernels.tracking.layout` has the arrays and `railfix.kernels.tracking.index` their indices.
`railfix.kernels.tracking.recursion.advance` returns at an epoch that requires a position search; the search is done
between the epoch's prediction and its update.

Single letters are indices: t epoch, h hypothesis, b source and its sub-filter, j measurement, k channel (term of a
quantity next to q, axis next to c), q quantity, i unknown, g clock, v vertex, c component x, y, z; a and b rows and
columns of a matrix. The letters x, P, F, Q, H, S, K, y, r, u, T, z are variables of the equations in
docs/filter-equations.md.
"""
