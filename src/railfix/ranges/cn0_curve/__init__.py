"""Mean C/N0 over elevation of an antenna and receiver: fitted, kept in a small file, looked up."""

from __future__ import annotations

from railfix.ranges.cn0_curve.curve import (
    KINDS,
    Cn0Curve,
    Cn0CurveSource,
    Cn0Mean,
    Cn0Samples,
    CurveFit,
    fit_cn0_curve,
    satellite_kind,
)
from railfix.ranges.cn0_curve.file import read_cn0_curve, write_cn0_curve
from railfix.ranges.cn0_curve.from_log import Cn0Calibration, cn0_curve_from_log, satellite_elevation_deg

__all__ = [
    "KINDS",
    "Cn0Calibration",
    "Cn0Curve",
    "Cn0CurveSource",
    "Cn0Mean",
    "Cn0Samples",
    "CurveFit",
    "cn0_curve_from_log",
    "fit_cn0_curve",
    "read_cn0_curve",
    "satellite_elevation_deg",
    "satellite_kind",
    "write_cn0_curve",
]
