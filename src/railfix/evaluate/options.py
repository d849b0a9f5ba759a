"""Choices of an evaluation."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from railfix.core.errors import SettingsError
from railfix.evaluate.bracket import LARGEST_GAP_S

Method = Literal["chainage", "trajectory"]


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """Choices of an evaluation.

    Attributes
    ----------
    method : {"auto", "chainage", "trajectory"}
        Errors as differences of chainage, or along the trajectory from the reference's place; "auto" takes
        the first where it can.
    reference_sigma_m : float
        Epochs whose reference is worse than this are left out of the errors.
    reference_gap_s : float
        Longest step of the reference that is bridged.
    standing_mps : float
        Below this the train stands.
    section_m : float
        Length of the sections of the line.
    speed_edges_kmh, satellite_edges : tuple
        Where one class ends and the next begins.
    over_m : tuple of float
        Sizes of error whose shares are told.
    alarm_limits_m : tuple of float
        What the protection level must stay within for the position to be available; each run is also counted at
        its own.
    block_s : float
        Length of the blocks that are drawn for the confidence.
    replicates, seed : int
        Draws, and the start of the random numbers.
    confidence : float
        Part of the draws within the limits told.
    """

    method: Literal["auto", "chainage", "trajectory"] = "auto"
    reference_sigma_m: float = 0.5
    reference_gap_s: float = LARGEST_GAP_S
    standing_mps: float = 0.3
    section_m: float = 1000.0
    speed_edges_kmh: tuple[float, ...] = (20.0, 60.0, 100.0)
    satellite_edges: tuple[int, ...] = (4, 5, 6, 7, 8, 10, 12, 15, 20)
    over_m: tuple[float, ...] = (5.0, 10.0, 20.0, 50.0)
    alarm_limits_m: tuple[float, ...] = (10.0, 20.0, 40.0)
    block_s: float = 60.0
    replicates: int = 1000
    seed: int = 0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        for name in ("reference_sigma_m", "reference_gap_s", "section_m", "block_s", "standing_mps"):
            value = getattr(self, name)
            if not (value > 0.0 and np.isfinite(value)):
                raise SettingsError(f"{name} is {value:g}; a positive number was expected")
        for name in ("speed_edges_kmh", "satellite_edges", "over_m"):
            edges = np.asarray(getattr(self, name), dtype=np.float64)
            if not (len(edges) and (edges > 0).all() and (np.diff(edges) > 0).all()):
                told = ", ".join(f"{edge:g}" for edge in edges)
                raise SettingsError(f"{name} is {told or 'empty'}; positive numbers that rise were expected")
        if wrong := [limit for limit in self.alarm_limits_m if not (limit > 0.0 and np.isfinite(limit))]:
            raise SettingsError(f"alarm_limits_m has {wrong[0]:g}; positive numbers of metres were expected")
        if self.replicates < 1 or self.seed < 0:
            raise SettingsError("replicates must be at least 1 and seed not negative")
        if not 0.0 < self.confidence < 1.0:
            raise SettingsError(f"confidence is {self.confidence:g}; a part between 0 and 1 was expected")

    @property
    def windows_s(self) -> tuple[float, ...]:
        """Windows of continuity: 15 s is an approach's in aviation; a minute, a station to the next."""
        return (15.0, 60.0)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)
