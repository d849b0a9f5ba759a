"""Settings of a run, from Python or from TOML; misspelt keys are rejected.

Each package defines its own limits; this module collects them under their names in the configuration file::

    preset = "default"
    systems = ["G", "J", "E", "C"]
    min_satellites = 3

    [elevation]
    mask_deg = 15.0

    [noise]
    model = "elevation"

A preset is a named set of settings; individual settings override it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

from pydantic import Field, create_model, field_validator, model_validator

from railfix.core.settings import Settings, validate
from railfix.core.settings_files import load_settings
from railfix.integrity.interference import InterferenceLimits
from railfix.integrity.persistent_biases import LastingErrorLimits
from railfix.integrity.protection import RiskBudget
from railfix.integrity.protection.araim import AraimBudget
from railfix.pipeline.sensor_epochs import SensorLimits
from railfix.positioning.carrier import ContinuityLimits, CycleSlipLimits, PhaseLimits, SmoothingLimits
from railfix.positioning.igg3_fit import RobustFitLimits
from railfix.positioning.inter_system import ClockOffsetLimits
from railfix.positioning.line_fix import FixLimits
from railfix.positioning.map_offset import MapOffsetLimits
from railfix.positioning.normal_equations import ConstrainedLimits, SinglePointLimits
from railfix.positioning.receiver_noise import NoiseScaleLimits
from railfix.positioning.section_search import SectionLimits
from railfix.positioning.two_frequencies import TwoFrequencyLimits
from railfix.ranges.base_station import BaseLimits
from railfix.ranges.channels import DEFAULT_SIGNALS
from railfix.ranges.range_sigma import CodeNoise, NominalErrors
from railfix.ranges.sbas import SbasLimits
from railfix.screens import SCREENS
from railfix.tracking.limits import TrackingLimits

if TYPE_CHECKING:
    from railfix.integrity.raim import RaimLimits
    from railfix.screens import AntennaPairLimits, AntennaSpacingLimits, Cn0Limits, DopplerLimits, ElevationLimits


#: Names of the measurements that the filter along the track can use, as in `Config.filter_sources`.
FilterSource = Literal["code", "phase", "doppler", "wheel", "radar", "force", "feature", "balise", "range"]
FILTER_SOURCES: Final[tuple[FilterSource, ...]] = (
    "code", "phase", "doppler", "wheel", "radar", "force", "feature", "balise", "range",
)  # fmt: skip

#: Names of the screens, in the order in which they are run.
SCREEN_NAMES: Final = tuple(screen.name for screen in SCREENS)

#: Settings of each preset. "strict" prefers accuracy to availability; "p1" is exactly table 6 of P1, for geodetic
#: receivers at 10 Hz.
PRESETS: Final[Mapping[str, Mapping[str, Any]]] = {
    "default": {},
    "strict": {"largest_sigma_m": 10.0, "failed_checks": "drop"},
    "p1": {
        "largest_sigma_m": 1e6,
        "map_plan_sigma_m": 1e-3,
        "map_height_sigma_m": 1e-3,
        "min_satellites": 3,
        "failed_checks": "drop",
        "elevation": {"mask_deg": 20.0},
        "cn0": {"floor_dbhz": 30.0, "deficit_dbhz": 10.0},
        "doppler": {"mode": "fixed", "step_m": 1.5, "hold_s": 0.0, "verdict": "reject"},
        "antenna_pair": {"limit_m": 5.0, "clocks": "common", "verdict": "reject"},
        "raim": {"mode": "fixed", "fixed_limit_m2": 100.0, "max_excluded": 2},
        "antenna_spacing": {"limit_m": 5.0},
    },
}


if TYPE_CHECKING:

    class ScreenSettings(Settings):
        """Limits of the screens; the fields, one for each screen in `SCREENS`, are created at run time."""

        elevation: ElevationLimits = ElevationLimits()
        cn0: Cn0Limits = Cn0Limits()
        doppler: DopplerLimits = DopplerLimits()
        antenna_pair: AntennaPairLimits = AntennaPairLimits()
        raim: RaimLimits = RaimLimits()
        antenna_spacing: AntennaSpacingLimits = AntennaSpacingLimits()
else:
    ScreenSettings = create_model(
        "ScreenSettings", __base__=Settings, **{screen.name: (type(screen.limits), screen.limits) for screen in SCREENS}
    )

#: The filter drops its position after this time off the map, and restarts after the same time on the map [s]. On
#: recorded runs with a correct map, no two consecutive positions are off the map.
OFF_MAP_S: Final = 10.0


class Config(ScreenSettings):
    """Positioning settings, with their defaults and the sources of the defaults.

    Attributes
    ----------
    elevation, cn0, doppler, antenna_pair, raim, antenna_spacing
        Limits of the screens.
    """

    #: Base preset; other settings override it. "p1" is table 6 of P1: elevation mask 20 deg; C/N0 from 30 dB-Hz, at
    #: most 10 dB below the curve; Doppler limit 1.5 m, no hold; antenna pair 5 m, one clock for both receivers (P1
    #: 2.3(3)); RAIM 100 m^2, two exclusions; antenna spacing 5 m; no positions with failed checks. Settings that P1
    #: does not specify (weights, noise, inter-system biases, ambiguous sections) are as in "default".
    preset: Literal["default", "strict", "p1"] = "default"
    #: Constellations used. GLONASS is left out by default, because code biases between its channels reach metres.
    systems: tuple[Literal["G", "J", "E", "C", "R"], ...] = ("G", "J", "E", "C")
    #: Satellites (such as "G07") and constellations (such as "C") that are not used.
    exclude: tuple[Annotated[str, Field(pattern=r"^[GJECR]([0-9]{2})?$")], ...] = ()
    #: Signals of each constellation in order of preference; the first observed signal is used.
    signals: dict[str, tuple[str, ...]] = Field(default_factory=lambda: dict(DEFAULT_SIGNALS))
    #: Number of frequencies whose codes are used per satellite; always one with a base station or with SBAS on L1.
    frequencies: Literal["one", "two"] = "one"
    two_frequencies: TwoFrequencyLimits = TwoFrequencyLimits()  #: Limits of the combination of a satellite's two codes.
    #: Names of the active screens. Satellite health and record validity are always checked.
    screens: tuple[str, ...] = SCREEN_NAMES
    #: File with mean C/N0 by elevation, written by ``railfix cn0-curve``. Without a file, only the C/N0 floor applies.
    cn0_curve: Path | None = None
    #: Treatment of positions with a failed check (`reasons.CHECK_FAILED`): "keep" sets the status of the check; "drop"
    #: also removes the coordinates, as in P1.
    failed_checks: Literal["keep", "drop"] = "keep"
    #: A position whose single-epoch sigma (`Solution.epoch_sigma_m`) exceeds this limit gets the status `uncertain`,
    #: which counts as a failed check. With ``carrier`` "float" or "fixed", the limit applies to the sigma of the
    #: published position. P4 accepts a car length, 20 m; the preset "strict" uses 10 m and drops failed checks.
    largest_sigma_m: float = Field(default=20.0, gt=0)
    #: Minimum number of satellites for a position. P1 3.2 uses 3; with 2, positions in curves are ambiguous.
    min_satellites: int = Field(default=3, ge=2)
    dilution_limit: float = Field(default=20.0, gt=0)  #: No position if the along-track dilution [m/m] exceeds this.
    #: Probability that a position on the map counts as off the map because of noise. The noise is estimated from the
    #: residuals of the 3-D fit.
    off_map_risk: float = Field(default=1e-6, gt=0, lt=1)
    #: Largest acceptable probability that the train is not on the reported track. Above this limit, positions on a
    #: network are neither `ok` nor `tracking`, and have no protection level. `railfix which-track` uses the same limit.
    track_risk: float = Field(default=1e-3, gt=0, lt=1)
    ionosphere: Literal["klobuchar", "off"] = "klobuchar"  #: Model of the ionospheric delay.
    troposphere: Literal["saastamoinen", "off"] = "saastamoinen"  #: Model of the tropospheric delay.
    #: Navigation records older than this are not used, even if they are valid; by default, valid records are used.
    max_ephemeris_age_s: float | None = Field(default=None, gt=0)
    #: Standard deviations of map errors; they replace the track file's values (P1: 0.30 m in plan, 0.60 m in height).
    map_plan_sigma_m: float | None = Field(default=None, gt=0)
    map_height_sigma_m: float | None = Field(default=None, gt=0)
    noise_scale: NoiseScaleLimits = NoiseScaleLimits()  #: Estimation of the receiver's noise from the residuals.
    #: Test for range errors that persist for a minute or longer.
    lasting_errors: LastingErrorLimits = LastingErrorLimits()
    #: Selection of an epoch's consistent ranges; inter-system biases and noise are estimated from these ranges.
    robust_fit: RobustFitLimits = RobustFitLimits()
    map_offset: MapOffsetLimits = MapOffsetLimits()  #: Test of the map with 3-D positions of the last minutes.
    interference: InterferenceLimits = InterferenceLimits()  #: Detection of jamming and spoofing.
    noise: CodeNoise = CodeNoise()  #: Model of the range sigmas, which determine the weights.
    #: Files of SBAS messages, or "stream" for messages that the receivers pass on; empty if SBAS is not used. SBAS
    #: replaces the models of `ionosphere` and `troposphere`; satellites without a valid correction are rejected.
    sbas: tuple[Path, ...] | Literal["stream"] = ()
    #: SBAS messages to use: L1 messages correct GPS L1 C/A; L5 messages (dual-frequency) correct the ionosphere-free
    #: codes of GPS L1 C/A and L5, and of Galileo E1 and E5a. With L5, satellites without both codes are rejected.
    sbas_band: Literal["L1", "L5"] = "L1"
    #: PRN of the GEO whose messages are used; "best" is the GEO with the most usable (on L1: fast) corrections.
    sbas_prn: int | Literal["best"] = "best"
    #: SBAS time-outs, use of message type 0, and treatment of missing degradation data.
    sbas_limits: SbasLimits = SbasLimits()
    base: BaseLimits = BaseLimits()  #: Limits of the corrections by a base station.
    #: File with overbounds of the range errors by direction and C/N0, written by ``railfix error-model``. For the
    #: protection level, each range sigma is raised at least to the sigma of the overbound. Weights, screens and RAIM
    #: use `noise` alone. Without the file, the protection level uses `noise` times the noise scale estimated so far;
    #: this product does not bound the tails of the errors.
    error_model: Path | None = None
    #: Satellite and atmospheric errors. Without SBAS, they are added to the local errors of `error_model`.
    nominal: NominalErrors = NominalErrors()
    protection: Literal["on", "off"] = "on"  #: Computation of the along-track protection level.
    #: Integrity risk per hour, its allocation, and the assumed fault probabilities.
    risk: RiskBudget = RiskBudget()
    #: Integrity support message (TOML, ``docs/protection-level.md``) for additional ARAIM levels, along the track and
    #: in 3-D. The message cannot be combined with SBAS.
    integrity_support: Path | None = None
    araim: AraimBudget = AraimBudget()  #: Risk allocation of the ARAIM levels.
    #: A position is available only if its protection level is at most this. P4 uses a car length, 20 m.
    alarm_limit_m: float = Field(default=20.0, gt=0, le=1e5)
    #: Chainage intervals in which local faults cannot be bounded, so that the protection level is infinite. ``railfix
    #: error-model`` prints the intervals that it finds.
    no_level_m: tuple[tuple[float, float], ...] = ()
    #: Computation of the RAIM protection level of P4: the largest slope times the largest undetected bias.
    raim_protection: Literal["on", "off"] = "off"
    #: Use of the carrier phase. "smoothed" smooths the codes. "float" and "fixed" estimate positions from the codes and
    #: phases up to the epoch, with float or integer ambiguities ("fixed" requires a base station). On recorded runs,
    #: smoothing helps phones most, and float ambiguities help most under open sky. In towns, where phase arcs last
    #: seconds, neither smoothing nor float ambiguities remove large errors.
    carrier: Literal["off", "smoothed", "float", "fixed"] = "off"
    #: Standard deviation of a carrier phase at the zenith, multipath included.
    phase_sigma_m: float = Field(default=0.01, gt=0)
    slips: CycleSlipLimits = CycleSlipLimits()  #: Limits of the cycle-slip detection.
    smoothing: SmoothingLimits = SmoothingLimits()  #: Limits of the smoothing of codes by the carrier phase.
    continuity: ContinuityLimits = ContinuityLimits()  #: Test of phase changes against motion along the line.
    phase: PhaseLimits = PhaseLimits()  #: Estimation of float ambiguities, and fixing to integers.
    #: Filter along the track. It combines codes, Dopplers, phase changes and sensor data up to the epoch.
    filter: Literal["track", "off"] = "track"
    #: Measurements of the filter. Satellites provide `code`, `phase` and `doppler`; all other measurements come from
    #: on-board sensors. `feature` is the position of a line feature that the inertial unit and the tachometer detect.
    filter_sources: tuple[FilterSource, ...] = FILTER_SOURCES
    tracking: TrackingLimits = TrackingLimits()  #: Process and measurement noise of the filter.
    sensors: SensorLimits = SensorLimits()  #: Noise of the on-board sensors, and data of the tachometer's wheel.
    clock_offsets: ClockOffsetLimits = ClockOffsetLimits()  #: Estimation of the inter-system biases.
    single_point: SinglePointLimits = SinglePointLimits()  #: Limits of the fit of single-epoch 3-D positions.
    section: SectionLimits = SectionLimits()  #: Limits of the test for ambiguous sections.
    constrained: ConstrainedLimits = ConstrainedLimits()  #: Limits of the iteration for positions on the line.

    @model_validator(mode="before")
    @classmethod
    def _on_preset(cls, values: Any) -> Any:
        """Override the preset with given settings; the validation of the field `preset` rejects an unknown preset."""
        if not isinstance(values, dict):
            return values
        return _over(PRESETS.get(str(values.get("preset", "default")), {}), values)

    @field_validator("systems")
    @classmethod
    def _some_system_once(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if not value or len(set(value)) != len(value):
            raise ValueError("specify at least one constellation, and each only once")
        return value

    @field_validator("screens")
    @classmethod
    def _known_screens_once(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in value if name not in SCREEN_NAMES]
        if unknown:
            raise ValueError(f"unknown screen {unknown[0]!r}; known are {', '.join(SCREEN_NAMES)}")
        if len(set(value)) != len(value):
            raise ValueError("name each screen once")
        return tuple(name for name in SCREEN_NAMES if name in value)

    @field_validator("filter_sources")
    @classmethod
    def _codes_and_each_once(cls, value: tuple[FilterSource, ...]) -> tuple[FilterSource, ...]:
        if "code" not in value or len(set(value)) != len(value):
            raise ValueError("list each measurement only once, and include code: the filter needs it to start")
        return tuple(name for name in FILTER_SOURCES if name in value)

    @field_validator("sbas_prn")
    @classmethod
    def _check_geo(cls, value: int | str) -> int | str:
        if isinstance(value, int) and not (120 <= value <= 158 or 183 <= value <= 202):
            raise ValueError("a PRN of SBAS (120 to 158), of QZSS (183 to 202) or 'best' was expected")
        return value

    @model_validator(mode="after")
    def _codes_with_l5(self) -> Self:
        if self.dual_frequency_sbas and self.carrier in ("float", "fixed"):
            raise ValueError(
                f"sbas_band = L5 corrects codes of two frequencies, but carrier = {self.carrier} uses the phase of one "
                "frequency: set carrier = off or smoothed"
            )
        return self

    @property
    def dual_frequency_sbas(self) -> bool:
        """Whether SBAS on L5 corrects ionosphere-free codes."""
        return bool(self.sbas) and self.sbas_band == "L5"

    @model_validator(mode="after")
    def _support_without_sbas(self) -> Self:
        if self.integrity_support is not None and self.sbas:
            raise ValueError("integrity_support and SBAS both specify the satellite errors: use only one of them")
        return self

    @cached_property
    def fix_limits(self) -> FixLimits:
        """Limits of the 3-D position, the section search and the position on the line."""
        return FixLimits(self.min_satellites, self.single_point, self.section, self.constrained)

    @cached_property
    def local_risk(self) -> RiskBudget:
        """Risk budget with SBAS: local faults only, because SBAS covers satellite faults."""
        none = dict.fromkeys(self.risk.satellite_prior, 0.0)
        return self.risk.replaced(satellite_prior=none, constellation_prior={})

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain values for JSON."""
        return self.model_dump(mode="json")


def _over(preset: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Override a preset. Groups are merged by key, but limits given as an object replace the whole group."""
    both = {**preset, **values}
    for name, group in preset.items():
        given = values.get(name)
        if isinstance(group, Mapping) and isinstance(given, Mapping):
            both[name] = {**group, **given}
    return both


def parse_config(values: Mapping[str, Any], *, source: str = "settings") -> Config:
    """Return a configuration from plain values.

    Raises
    ------
    SettingsError
        The message names the source, the setting, and the expected value.
    """
    return validate(Config, values, source=source)


def load_config(path: str | PathLike[str]) -> Config:
    """Return a configuration from a TOML file.

    Raises
    ------
    InputFileError
        The file is missing, unreadable, or not TOML.
    SettingsError
        A setting is misspelt or out of range.
    """
    return load_settings(Config, path, what="a configuration file")
