"""Mean C/N0 over elevation of an antenna and receiver: fitted, kept in a small file, looked up."""

from __future__ import annotations

from railfix.cn0_curve.curve import (
    KINDS,
    Cn0Curve,
    Cn0CurveSource,
    Cn0Mean,
    Cn0Samples,
    CurveFit,
    fit_cn0_curve,
    kind_names,
    satellite_kind,
)
from railfix.cn0_curve.file import read_cn0_curve, write_cn0_curve

__all__ = [
    "KINDS",
    "Cn0Curve",
    "Cn0CurveSource",
    "Cn0Mean",
    "Cn0Samples",
    "CurveFit",
    "fit_cn0_curve",
    "kind_names",
    "read_cn0_curve",
    "satellite_kind",
    "write_cn0_curve",
]
