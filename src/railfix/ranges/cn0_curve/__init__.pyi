# The names of `railfix.ranges.cn0_curve`, imported at their first use (lazy-loader).

from .curve import (
    KINDS,
    Cn0Curve,
    Cn0CurveSource,
    Cn0Mean,
    Cn0Samples,
    CurveFit,
    SourceFile,
    fit_cn0_curve,
    read_cn0_curve,
    satellite_kind,
    write_cn0_curve,
)
from .from_log import Cn0Calibration, cn0_curve_from_log, satellite_elevation_deg

__all__ = [
    "KINDS",
    "Cn0Calibration",
    "Cn0Curve",
    "Cn0CurveSource",
    "Cn0Mean",
    "Cn0Samples",
    "CurveFit",
    "SourceFile",
    "cn0_curve_from_log",
    "fit_cn0_curve",
    "read_cn0_curve",
    "satellite_elevation_deg",
    "satellite_kind",
    "write_cn0_curve",
]
