# The names of `railfix.positioning`, imported at their first use (lazy-loader).

from .antenna_rows import AntennaRows
from .approximate import ApproximatePosition, approximate_position
from .igg3_fit import RobustFit, RobustFitLimits, robust_fit, robust_on_line
from .inter_system import (
    ClockOffsetLimits,
    OffsetState,
    PointPositions,
    TieLimits,
    tie_clocks,
    tie_constellations,
)
from .line_fix import FixLimits, LineFix, fix_on_line
from .noise_windows import Windows
from .normal_equations import (
    Constrained,
    ConstrainedLimits,
    SinglePoint,
    SinglePointLimits,
    point_position,
    position_on_line,
)
from .range_arrays import InterSystemBiases, Ranges, weighted_ranges, without
from .receiver_noise import NoiseScaleLimits, noise_scale
from .search_index import SearchIndex
from .section_search import Section, SectionLimits, find_section

__all__ = [
    "AntennaRows",
    "ApproximatePosition",
    "ClockOffsetLimits",
    "Constrained",
    "ConstrainedLimits",
    "FixLimits",
    "InterSystemBiases",
    "LineFix",
    "NoiseScaleLimits",
    "OffsetState",
    "PointPositions",
    "Ranges",
    "RobustFit",
    "RobustFitLimits",
    "SearchIndex",
    "Section",
    "SectionLimits",
    "SinglePoint",
    "SinglePointLimits",
    "TieLimits",
    "Windows",
    "approximate_position",
    "find_section",
    "fix_on_line",
    "noise_scale",
    "point_position",
    "position_on_line",
    "robust_fit",
    "robust_on_line",
    "tie_clocks",
    "tie_constellations",
    "weighted_ranges",
    "without",
]
