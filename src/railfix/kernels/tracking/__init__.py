"""Compiled recursion of `railfix.tracking.filter`: ordinary epochs one after the other, hypotheses side by side.

The same equations as in numpy, over the unknowns that are in use (compact ones, in the order of
`railfix.kernels.tracking.layout`) and seven that last an epoch. Starts, gaps, searches and epochs without a measurement
are left to numpy: `railfix.kernels.tracking.recursion.advance` returns at such an epoch.
"""
