"""Compiled form of the recursion over epochs in `railfix.tracking.filter`.

`railfix.kernels.tracking.layout` defines the arrays and `railfix.kernels.tracking.index` their indices.
`railfix.kernels.tracking.recursion.advance` returns at an epoch that requires a position search. The search takes place
after the prediction to this epoch and before its update.

Single letters are indices: t epoch, h hypothesis, b source (and the sub-filter without this source), j measurement, k
channel (or term of a quantity), q quantity, i unknown, g clock, v vertex, c component x, y, z. Loops over the elements
of a matrix use the next free letters of a, b, c, i, j. docs/filter-equations.md defines the letters x, P, F, Q, H, T,
z, y, S and g = P h, and has a table of further letters.
"""
