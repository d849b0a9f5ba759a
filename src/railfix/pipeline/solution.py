"""Outputs of the positioning stages, from the 3-D position to the protection level."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from railfix.core.arrays import Codes, Floats, Masks, read_only
from railfix.core.notebook import NotebookTable
from railfix.core.reasons import CHECK_FAILED, POSITIONED, Status
from railfix.integrity.fault_exclusion import RaimResult
from railfix.integrity.protection import ProtectionLevel
from railfix.integrity.protection.araim import AraimResult
from railfix.positioning.carrier import PhasePositions
from railfix.positioning.line_fix import LineFix
from railfix.positioning.map_offset import MapOffset
from railfix.positioning.normal_equations import SinglePoint
from railfix.positioning.range_arrays import InterSystemBiases


@dataclass(frozen=True, kw_only=True, repr=False)
class ProtectionResult(NotebookTable):
    """Protection levels of T epochs."""

    #: Protection levels; NaN at epochs without a position, or with a fault that remains after RAIM.
    level: ProtectionLevel
    status: Codes  #: `protection.LevelStatus` for `Config.alarm_limit_m`, shape (T,).
    kind: str  #: Fault hypotheses of the levels: "sbas" or "separation" (`level_stage.KINDS`).
    basis: str  #: "measured" or "indicative": whether the priors were measured on the line (`level_stage.BASES`).


@dataclass(frozen=True, kw_only=True, repr=False)
class Solution(NotebookTable):
    """Outputs of the positioning stages at T epochs."""

    point: SinglePoint  #: Conventional 3-D position, with one clock per constellation.
    #: 3-D positions from the ranges that remain after exclusions; NaN if these are inconsistent; shape (T, 3).
    consistent_ecef_m: Floats
    #: `railfix.integrity.PointStatus` of the conventional position, shape (T,).
    conventional_status: Codes
    fix: LineFix  #: Positions on the line from codes, after exclusions.
    ties: InterSystemBiases  #: Inter-system biases known before each epoch, for `Channels.clocks`.
    raim: RaimResult  #: Result of RAIM; `outcome` is UNTESTABLE at all epochs if RAIM is off.
    status: Codes  #: `reasons.Status`, shape (T,).
    #: Ratio of the receiver's range standard deviation to the assumed value, shape (T,): root mean square, over earlier
    #: epochs with exponential forgetting, of the normalised residuals that remain after RAIM.
    noise_scale: Floats
    #: Single-epoch sigma: standard deviation along the line from the codes of the epoch alone. It uses the larger of
    #: the receiver's noise and the noise estimated from the epoch's residuals, and is larger, by Student's t, if few
    #: ranges are redundant. Epochs with a dropped position have a value as well; shape (T,).
    epoch_sigma_m: Floats
    #: Position along the antenna's trajectory, from codes or from code and phase; shape (T,).
    arc_m: Floats
    #: Standard deviation along the line. It combines the range noise (from the weights and the residuals of this and
    #: earlier epochs), the satellite and atmospheric errors, the map error, and the distance to an unresolved
    #: alternative position, weighted by the alternative's probability; shape (T,).
    along_sigma_m: Floats
    #: Positions from code and phase if ``Config.carrier`` is "float" or "fixed"; `arc_m` then has these positions.
    phase: PhasePositions | None
    protection: ProtectionResult | None  #: Protection levels along the line; None if the levels are off.
    map_offset: MapOffset  #: Mean offset of the last minutes' 3-D positions from the line.
    off_map: Masks  #: True where the train is away from the line (`railfix.pipeline.off_map`); shape (T,).
    araim: AraimResult | None = None  #: ARAIM levels; None without an integrity support message.


@lru_cache
def with_coordinates(failed_checks: str) -> Masks:
    """Return for each status number whether positions of that status have coordinates under `failed_checks`."""
    dropped = CHECK_FAILED if failed_checks == "drop" else ()
    return read_only(np.array([status in POSITIONED and status not in dropped for status in sorted(Status)]))
