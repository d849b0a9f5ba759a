"""Compiled recursion of `railfix.tracking.filter`: ordinary epochs one after the other, hypotheses side by side.

`railfix.kernels.tracking.layout` has the arrays and `railfix.kernels.tracking.index` their indices.
`railfix.kernels.tracking.recursion.advance` returns at an epoch whose places have to be searched for, which is done
between its prediction and its update.

One letter is an index: t of an epoch, h of a hypothesis, b of a source and its sub-filter, j of a measurement, k of a
channel (of a term of a quantity where q is there, of an axis where c is there), q of a quantity, i of an unknown, g of
a clock, v of a vertex, c of x, y, z; a and b of rows and columns of a matrix. Others are of the equations: x, P, F, Q,
H, S, K, y, r, u, T, z as in docs/filter-equations.md.
"""
