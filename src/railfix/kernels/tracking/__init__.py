"""Compiled recursion of `railfix.tracking.filter`: ordinary epochs one after the other, hypotheses side by side.

`railfix.kernels.tracking.layout` has the unknowns and the arrays. `railfix.kernels.tracking.recursion.advance` returns
at an epoch whose places have to be searched for, which is done between its prediction and its update.
"""
