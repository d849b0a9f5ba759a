"""Protection levels on real recordings with references, each by error models of other recordings.

``python tests/studies/integrity_recordings.py FOLDER`` with the recordings beside the checkout writes references, maps,
runs and models to the folder, and prints the tables of ``docs/level-results.md``.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

import paths
import recordings_ablate
import recordings_score
from railfix.core.geodesy import range_with_rotation
from railfix.core.reasons import CHECK_FAILED, Status
from railfix.evaluate import along_track_error, interpolate_reference
from railfix.evaluate.range_errors import ModelInputs, error_model_from_runs
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.integrity.protection import ProtectionLevel, protection_level
from railfix.integrity.raim import linear_model
from railfix.integrity.stanford import Stanford, stanford
from railfix.io import read_navigation, read_observations
from railfix.io.reference_log import AntennaReference, read_reference
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.level_stage import get_risk_budget
from railfix.pipeline.results import AntennaResult
from railfix.positioning.range_arrays import FILLER_SATELLITE_M, Ranges
from railfix.ranges.channels import clock_groups
from railfix.ranges.error_model import ErrorBins, write_error_model
from railfix.ranges.error_model_fit import ErrorModelFit
from railfix.run.driver import open_inputs
from railfix.run.processor_setup import make_processor
from railfix.run.record import read_record
from railfix.track.trajectory import Trajectory

MASK: Final = {"elevation": {"mask_deg": 15.0}}
ALARM_LIMITS_M: Final = (10.0, 20.0, 40.0)
#: Weights by their name: none (noise settings times the estimated scale, 1 at least in the level), or the runs that
#: an error model is made from.
#: "base" is Japan with its reference station: what is local of a geodetic receiver under open sky. "half" is the
#: recording's own first half; the second one is judged. "no C/N0" is of one bin: these logs
#: do not have any. "scale": as none, but the sigmas of the level scaled down as well.
MODELS: Final = {
    "urbannav_f9p": {
        "none": (),
        "none, scale as estimated": ("scale",),
        "other receiver, same car": ("urbannav_m8t",),
        "other cities": ("gsdc", "japan"),
        "all others": ("urbannav_m8t", "gsdc", "japan"),
        "own first half": ("half",),
        "open sky, base": ("base",),
    },
    "urbannav_m8t": {
        "none": (),
        "none, scale as estimated": ("scale",),
        "other receiver, same car": ("urbannav_f9p",),
        "other cities": ("gsdc", "japan"),
        "all others": ("urbannav_f9p", "gsdc", "japan"),
        "own first half": ("half",),
        "open sky, base": ("base",),
    },
    "gsdc": {
        "none": (),
        "none, scale as estimated": ("scale",),
        "all others": ("urbannav_f9p", "urbannav_m8t", "japan"),
        "own first half": ("half",),
        "open sky, base": ("base",),
    },
    "japan": {
        "none": (),
        "none, scale as estimated": ("scale",),
        "all others": ("urbannav_f9p", "urbannav_m8t", "gsdc"),
        "own first half": ("half",),
        "own first half, base": ("half", "base"),
    },
    "geonet2005": {
        "none": (),
        "none, scale as estimated": ("scale",),
        "open sky, base": ("base",),
        "same, no C/N0": ("base", "no C/N0"),
        "all others, no C/N0": ("urbannav_f9p", "urbannav_m8t", "gsdc", "japan", "no C/N0"),
    },
}
JAPAN_BASE: Final = "japan_mosaic_2021265_with_GEONET3034/3034265G.21O"


@dataclass(frozen=True)
class Recording:
    """Log, navigation, line and reference of one antenna."""

    name: str
    observations: Observations
    navigation: Navigation
    trajectory: Trajectory
    reference: AntennaReference


@dataclass(frozen=True)
class Judged:
    """A recording with the levels that one choice of weights gives it, T epochs by K channels."""

    name: str
    model: str
    result: AntennaResult
    trajectory: Trajectory
    observed: np.ndarray  # epochs with observations inside the reference
    error_m: np.ndarray
    from_ranges_m: np.ndarray  # along the line, by the errors of the ranges used

    @property
    def level_m(self) -> np.ndarray:
        """Levels alone: infinite where the ranges contradict each other (alarm)."""
        level = self.result.protection.level
        return np.where(level.consistent | np.isnan(level.level_m), level.level_m, np.inf)

    @property
    def verdict_m(self) -> np.ndarray:
        """The same, infinite where the position's own checks have something against it."""
        against = [*CHECK_FAILED, Status.AMBIGUOUS, Status.OFF_MAP]
        return np.where(np.isin(self.result.status, against), np.inf, self.level_m)

    @property
    def over(self) -> int:
        """Number of epochs with a consistent level that the error passes."""
        return int(np.count_nonzero(np.abs(self.error_m) > self.level_m))

    @property
    def alarms(self) -> np.ndarray:
        level = self.result.protection.level
        return np.isfinite(self.error_m) & ~level.consistent & ~np.isnan(level.level_m)

    def diagram(self, limit_m: float, level_m: np.ndarray) -> Stanford:
        rows = self.observed
        return stanford(self.result.time[rows], self.error_m[rows], level_m[rows], alarm_limit_m=limit_m)


# ---- recordings and models ----------------------------------------------------------------------------------


def write_runs(data: Path, folder: Path) -> None:
    """References, maps and the runs that models are made from, whole and of the first half alone."""
    folder.mkdir(parents=True, exist_ok=True)
    recordings_ablate.prepared(data, folder)
    for name in recordings_ablate.RECORDINGS:
        options = recordings_ablate.options_of(data, folder, name)
        del options["--truth"]
        words = [word for option, path in options.items() for word in (option, str(path))]
        words = ["run", *words, "--set", "elevation.mask_deg=15", "--overwrite"]
        recordings_ablate.printed([*words, "--out", str(folder / name)])
        half = str(middle_of(read_observations(options["--front"])))
        recordings_ablate.printed([*words, "--end", half, "--out", str(folder / f"{name}_half")])


def middle_of(observations: Observations) -> np.datetime64:
    time = observations.time
    return (time[0] + (time[-1] - time[0]) // 2).astype("datetime64[s]")


def write_model(data: Path, folder: Path, target: str, sources: tuple[str, ...]) -> Path:
    """The error model of some recordings."""
    path = folder / f"{target} by {'+'.join(s.replace('/', '') for s in sources)}.toml"
    words = set(sources) & {"base", "half", "no C/N0"}
    runs = [source for source in sources if source not in words] or [target if "half" in words else "japan"]
    inputs = [
        ModelInputs(
            run=folder / (f"{name}_half" if "half" in words else name),
            reference=truth_of(folder, name),
            base=(data / "kinematic" / JAPAN_BASE,) if "base" in words else (),
        )
        for name in runs
    ]
    of_bins = ErrorModelFit(bins=ErrorBins(cn0_dbhz=(0.0, 60.0))) if "no C/N0" in words else None
    model, _ = error_model_from_runs(inputs, fit=of_bins)
    write_error_model(model, path)
    return path


def truth_of(folder: Path, name: str) -> Path:
    return folder / f"{recordings_ablate.RECORDINGS[name][2]}_truth.csv"


def recording_of(folder: Path, name: str) -> Recording:
    past = read_record(folder / name)
    navigation, line, logs = open_inputs(past.inputs, past.options, past.config)
    (antenna,) = logs
    reference = read_reference(truth_of(folder, name), (antenna,))[antenna]
    return Recording(
        name, read_observations(past.inputs.logs[antenna]), navigation, line.trajectories[antenna], reference
    )


def stations(data: Path) -> list[Recording]:
    """Two stations of 2005 played as trains, on level lines of four azimuths through each."""
    found, folder = [], data / "static" / "rtklib_geonet2005"
    for name in ("0759", "3040"):
        observations = read_observations(folder / f"{name}0920.05o")
        navigation = read_navigation([folder / f"{name}0920.05n"])
        place, count = observations.header.approximate_ecef_m, len(observations.time)
        nothing = np.full(count, np.nan)
        reference = AntennaReference(
            time=observations.time,
            ecef_m=np.broadcast_to(place, (count, 3)),
            chainage_m=nothing,
            speed_mps=nothing,
            sigma_m=nothing,
            source=np.full(count, ""),
            environment=np.full(count, ""),
        )
        for azimuth in (0, 45, 90, 135):
            line = recordings_score.straight_line(place, azimuth)
            found.append(Recording(f"{name} {azimuth:3d} deg", observations, navigation, line, reference))
    return found


def recordings_of(data: Path, folder: Path, name: str) -> list[Recording]:
    return stations(data) if name == "geonet2005" else [recording_of(folder, name)]


# ---- levels and what they have to bound ---------------------------------------------------------------------


def judged(
    one: Recording, model: str, file: Path | None, *, since: np.datetime64 | None = None, least_scale: float = 1.0
) -> Judged:
    """Positions weighted by a model, levels, errors of positions and of ranges; judged from an epoch on."""
    config = parse_config({"filter": "off", **MASK, **({} if file is None else {"error_model": str(file)})})
    processor = make_processor(config, one.navigation, {"front": one.trajectory})
    result = processor.process({"front": one.observations})[0].antennas["front"]
    if least_scale < 1.0:
        level = _with_scale(one, result, config, np.maximum(result.noise_scale, least_scale))
        result = replace(result, protection=replace(result.protection, level=level))
    place = interpolate_reference(result.time, one.reference.time, one.reference.ecef_m)
    error = along_track_error(result.arc_m, place, one.trajectory)
    used = (result.reason[:, result.columns] == 0) & np.isfinite(result.sigma_m[:, result.columns])
    gain, misfit = _moved(one, result, used, place)
    observed = np.isfinite(place[:, 0]) & np.any((result.reason & 1) == 0, axis=1)
    if since is not None:
        observed &= result.time >= since
    error = np.where(observed, error, np.nan)
    return Judged(
        name=one.name,
        model=model,
        result=result,
        trajectory=one.trajectory,
        observed=observed,
        error_m=error,
        from_ranges_m=np.where(used, gain * misfit, 0.0).sum(axis=1),
    )


def _with_scale(one: Recording, result: AntennaResult, config: Config, scale: np.ndarray) -> ProtectionLevel:
    """The levels of the run with another scale of the ranges' sigmas."""
    has = np.isfinite(result.protection.level.level_m)
    arc, section = np.where(has, result.fix.constrained.arc_m, np.nan), np.maximum(result.fix.constrained.section, 0)
    return protection_level(
        linear_model(ranges_of(result), one.trajectory, arc, section=section),
        [name[0] for name in result.satellite[result.columns].tolist()],
        risk=get_risk_budget(config),
        scale=scale,
        n_excluded=result.raim.excluded.sum(axis=1),
    )


def ranges_of(result: AntennaResult) -> Ranges:
    """The ranges that the positions were solved with in the end, from what the result tells."""
    columns = result.columns
    sigma, code = result.sigma_m[:, columns], result.corrected_code_m[:, columns]
    used = (result.reason[:, columns] == 0) & np.isfinite(sigma) & np.isfinite(code)
    return Ranges(
        sat_ecef_m=np.where(used[..., None], result.corrected.satellites.position_ecef_m, FILLER_SATELLITE_M),
        code_m=np.where(used, code, 0.0),
        weight=np.where(used, 1.0 / np.where(used, sigma, 1.0) ** 2, 0.0),
        groups=clock_groups(result.satellite[columns].astype("<U1")),
        ties=result.ties if len(result.corrected.channels.clocks) > 1 else None,
    )


def _moved(one: Recording, result: AntennaResult, used: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a metre of each range does to the position along the line, and code less range to the true place less
    their median: errors of all clocks together, for constellations too small for a clock of their own."""
    ranges = ranges_of(result)
    arc = np.where(np.isfinite(result.arc_m), result.fix.constrained.arc_m, np.nan)
    section = np.maximum(result.fix.constrained.section, 0)
    model = linear_model(ranges, one.trajectory, arc, section=section)
    gain = np.einsum("tkj,tj->tk", model.design, model.covariance_m2[:, 0]) * model.root_weight
    offset = np.zeros(used.shape)
    if ranges.ties is not None:
        for g, group in enumerate(ranges.groups):
            offset[:, group] = np.where(ranges.ties.sigma_m[:, g] < 1e5, ranges.ties.offset_m[:, g], 0.0)[:, None]
    distance, _ = range_with_rotation(result.corrected.satellites.position_ecef_m, place[:, None, :])
    misfit = result.corrected_code_m[:, result.columns] - distance - offset
    says = np.where(used, misfit, np.nan)
    some = np.isfinite(says).any(axis=1)
    misfit[some] -= np.nanmedian(says[some], axis=1, keepdims=True)
    return gain, misfit


# ---- tables -------------------------------------------------------------------------------------------------

#: Recordings whose lines are counted together, with one choice of weights.
Group = list[Judged]


def table(groups: list[Group]) -> list[str]:
    """One row a recording and model: levels and errors of all positions, whatever their status."""
    rows = [
        f"{'':40s} {'':21s} level [m]       K sigma  error [m]           "
        "error/sigma  error/level     over       over K sigma",
        f"{'recording':14s} {'error model':25s} epochs levels alarms    50 %   95 %    50 %   50 %  95 %   max       "
        "68 %       largest   level  blocks   alone",
    ]
    for group in groups:
        level, error = _joined(group, "level_m"), np.abs(_joined(group, "error_m"))
        alone, sigma = _joined(group, "fault_free_m"), _joined(group, "sigma_m")
        finite, both = np.isfinite(level), np.isfinite(level) & np.isfinite(error)
        diagrams = [one.diagram(20.0, one.level_m) for one in group]
        words = [
            f"{_name(group)} {len(level):6d} {finite.sum():6d} {sum(one.alarms.sum() for one in group):6d}",
            f"{_percentile(level, 50):7.1f} {_percentile(level, 95):6.1f} {_percentile(alone[finite], 50):7.1f}",
            f"{_percentile(error, 50):6.2f} {_percentile(error, 95):5.1f} {np.nanmax(error):5.1f}",
            f"{_percentile(error[both] / sigma[both], 68):10.2f} {(error[both] / level[both]).max():13.2f}",
            f"{np.count_nonzero(error[both] > level[both]):7d}",
            f"{sum(d.misleading_blocks for d in diagrams):3d}/{sum(d.blocks for d in diagrams):3d}",
            f"{np.count_nonzero(error[both] > alone[both]):7d}",
        ]
        rows.append(" ".join(words))
    return rows


def availabilities(groups: list[Group]) -> list[str]:
    """Availability and continuity by levels alone, and by the pipeline's verdict."""
    rows = [
        f"{'':40s}  levels alone, alarm limit [m]:{'':34s}verdict: over",
        f"{'recording':14s} {'error model':25s}  available % 10    20    40  15 s % 20    40  60 s % 20    40"
        "  available % 10    20    40  the level",
    ]
    for group in groups:
        alone = [[one.diagram(limit, one.level_m) for one in group] for limit in ALARM_LIMITS_M]
        verdict = [[one.diagram(limit, one.verdict_m) for one in group] for limit in ALARM_LIMITS_M]
        over = sum(len(diagram.beyond) for diagram in verdict[0])
        words = [
            f"{_name(group)} {'':9s} {' '.join(f'{_available(found):5.1f}' for found in alone)}",
            f"{'':6s} {' '.join(_kept(found, 0) for found in alone[1:])}",
            f"{'':6s} {' '.join(_kept(found, 1) for found in alone[1:])}",
            f"{'':10s} {' '.join(f'{_available(found):5.1f}' for found in verdict)} {over:10d}",
        ]
        rows.append(" ".join(words))
    return rows


def total(groups: list[Group]) -> list[str]:
    """All of them together."""
    both = [np.isfinite(one.level_m) & np.isfinite(one.error_m) for group in groups for one in group]
    over = sum(one.over for group in groups for one in group)
    return [f"{sum(int(b.sum()) for b in both)} levels with an error, {over} of them passed by it"]


def _joined(group: Group, name: str) -> np.ndarray:
    """One array of all epochs that are judged."""
    parts = []
    for one in group:
        level = one.result.protection.level
        values = {"status": one.result.status, "fault_free_m": level.fault_free_m, "sigma_m": level.sigma_m}
        parts.append((values[name] if name in values else getattr(one, name))[one.observed])
    return np.concatenate(parts)


def _name(group: Group) -> str:
    name = group[0].name if len(group) == 1 else f"geonet2005 x {len(group)}"
    return f"{name:14s} {group[0].model:25s}"


def _percentile(values: np.ndarray, which: float) -> float:
    good = values[np.isfinite(values)]
    return float(np.percentile(good, which)) if len(good) else np.nan


def _available(found: list[Stanford]) -> float:
    return 100.0 * sum(d.available_rate * len(d.region) for d in found) / sum(len(d.region) for d in found)


def _kept(found: list[Stanford], which: int) -> str:
    windows = sum(d.continuity[which].windows for d in found)
    return f"{100.0 * sum(d.continuity[which].kept for d in found) / windows:5.1f}" if windows else "    -"


def everything(data: Path, folder: Path, names: list[str]) -> list[Group]:
    """All recordings with all their models."""
    write_runs(data, folder)
    found = []
    for name in names:
        recordings = recordings_of(data, folder, name)
        for model, sources in MODELS[name].items():
            file = write_model(data, folder, name, sources) if sources and sources != ("scale",) else None
            since = middle_of(recordings[0].observations) if "half" in sources else None
            least = 0.0 if sources == ("scale",) else 1.0
            found.append([judged(one, model, file, since=since, least_scale=least) for one in recordings])
    return found


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", default=list(MODELS), choices=list(MODELS))
    options = parser.parse_args()
    data = paths.ROOT.parent / "shared" / "data"
    if not data.is_dir():
        print(f"the real recordings are not at {data}", file=sys.stderr)
        return 1
    found = everything(data, options.folder, options.only)
    for part in (table, total, availabilities):
        print("\n".join(part(found)), end="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
