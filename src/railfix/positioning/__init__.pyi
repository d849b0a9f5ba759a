# The names of `railfix.positioning`, imported at their first use (lazy-loader).

from .normal_equations import Constrained, ConstrainedLimits, SinglePoint, SinglePointLimits
from .section_search import SearchIndex, Section, SectionLimits
from .stages import find_section, point_position, position_on_line, weighted_ranges

__all__ = [
    "Constrained",
    "ConstrainedLimits",
    "SearchIndex",
    "Section",
    "SectionLimits",
    "SinglePoint",
    "SinglePointLimits",
    "find_section",
    "point_position",
    "position_on_line",
    "weighted_ranges",
]
