"""Compiled recursion of `railfix.tracking.filter`: ordinary epochs one after the other, hypotheses side by side.

Its equations are over the unknowns that are in use (compact ones, in the order of
`railfix.kernels.tracking.layout`) and seven that last an epoch. `railfix.kernels.tracking.recursion.advance`
returns at an epoch whose places have to be searched for, which is done between its prediction and its update.
"""
