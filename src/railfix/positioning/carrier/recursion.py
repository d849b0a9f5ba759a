"""Linear recursions along time without a loop over epochs."""

from __future__ import annotations

from railfix.core.arrays import Floats


def linear_recursion(gain: Floats, drive: Floats) -> Floats:
    """``x_k = gain_k x_{k-1} + drive_k`` along axis 0 with x_{-1} = 0, without a loop over epochs.

    Pairs (gain, drive) are composed over strides of 1, 2, 4, ...: log2(T) passes over the arrays.
    No division and no growing product: gains in [0, 1] make it as stable as the recursion itself.
    """
    total, factor = drive.copy(), gain.copy()  # gains may have fewer elements, those of `drive` broadcast
    stride = 1
    while stride < len(total):
        total[stride:] = total[stride:] + factor[stride:] * total[:-stride]
        factor[stride:] = factor[stride:] * factor[:-stride]
        stride *= 2
    return total
