"""Positions of other programs as the table of a run, for `railfix.evaluate.evaluate_runs`; RTKLIB's single point."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from railfix import __version__
from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.errors import MismatchError
from railfix.core.files import fingerprint, read_bytes
from railfix.core.geodesy import sigma_along
from railfix.core.reasons import Status
from railfix.core.timescale import seconds
from railfix.evaluate.place import Answers, TrackFiles, find_trajectory
from railfix.evaluate.run_folder import CONVENTIONAL, RunFolder, floats, read_run
from railfix.io.position_log import PositionLog
from railfix.io.receiver.framing import head_of, is_receiver_log
from railfix.pipeline.config import Config
from railfix.run.inputs import Antenna, RunInputs
from railfix.run.output import OutputFolder
from railfix.track.trajectory import Trajectory

#: Row of RTKLIB's single point, and the program that computes it (Debian package rtklib).
RTKLIB_SINGLE: Final = "RTKLIB single point"
RTKLIB_PROGRAM: Final = "rnx2rtkp"
#: Share of the interval of the log within which a position belongs to an epoch.
_NEAR: Final = 0.4
_LONGEST_S: Final = 600.0
#: RTKLIB's bits of the constellations.
_SYSTEMS: Final = {"G": 1, "R": 4, "E": 8, "J": 16, "C": 32}


def rows_at_epochs(time: Datetimes, found: Datetimes) -> Indices:
    """Find the row of a log of positions that is nearest to each epoch, shape (T,); -1 without one near it.

    A position belongs to an epoch within 0.4 of the median interval: programs take the receiver's clock out of their
    time tags.

    Parameters
    ----------
    time, found : ndarray of datetime64[ns], shape (T,), (n,)
        Epochs, rising, at least two; times of the positions.
    """
    rows = np.full(len(time), -1, dtype=np.intp)
    known = np.flatnonzero(~np.isnat(found))
    index = np.clip(np.searchsorted(time, found[known]), 1, len(time) - 1)
    index -= (found[known] - time[index - 1]) < (time[index] - found[known])
    away = np.abs(seconds(found[known] - time[index]))
    near = np.flatnonzero(away < _NEAR * float(np.median(seconds(np.diff(time)))))
    nearest = near[np.argsort(-away[near], kind="stable")]  # the nearest is written last
    rows[index[nearest]] = known[nearest]
    return rows


def table_of_positions(log: PositionLog, epochs: pl.DataFrame, trajectory: Trajectory) -> pl.DataFrame:
    """Return positions of another program as a table of positions of a run: moved to the nearest point of the line.

    Parameters
    ----------
    log : PositionLog
    epochs : polars.DataFrame
        Positions of railfix of one antenna of the same log: the epochs that a rate is counted of.
    trajectory : Trajectory
        Path of that antenna.

    Returns
    -------
    polars.DataFrame
        `railfix.evaluate.run_folder.NEEDED`, satellites and conventional position null. The times are those of the
        positions, where there is one.
    """
    time = epochs["time_gpst"].to_numpy()
    row = rows_at_epochs(time, log.time)
    has = row >= 0
    ecef = np.where(has[:, None], log.ecef_m[row], np.nan)
    arc, _ = trajectory.nearest(ecef)
    sigma = np.where(has[:, None], log.sigma_m[row][:, [1, 0, 2]], np.nan)
    along = sigma_along(sigma, ecef, trajectory.tangent[trajectory.segment_at(arc)[0]])
    here = trajectory.at_arc(arc)
    silent = epochs["status"] == Status.NO_OBSERVATION.text
    without = np.where(silent.to_numpy(), Status.NO_OBSERVATION.text, Status.NO_CONVERGENCE.text)
    table = pl.DataFrame(
        {
            "time_gpst": np.where(has, log.time[row], time),
            "antenna": epochs["antenna"],
            "status": np.where(np.isfinite(arc), Status.OK.text, without),
            "chainage_m": trajectory.chainage_at(arc),
            "along_sigma_m": along,
            **{name: here[:, axis] for axis, name in enumerate(("x_m", "y_m", "z_m"))},
        },
        nan_to_null=True,
    )
    absent = [pl.lit(None, pl.Float64).alias(name) for name in ("n_used", *CONVENTIONAL)]
    return table.with_columns(absent)


def write_program_run(log: PositionLog, run: Path, out: Path, antenna: Antenna) -> None:
    """Write positions of another program as the folder of a run, which `railfix evaluate` reads as well.

    Parameters
    ----------
    log : PositionLog
    run : Path
        Folder of railfix's run on the same receiver log.
    out : Path
        Folder to write; what is there is replaced.
    antenna : {"front", "rear"}

    Raises
    ------
    MismatchError
        The run has no such antenna, or no position of the log lies near one of its epochs.
    """
    own = read_run(run)
    epochs = own.positions.filter(pl.col("antenna") == antenna)
    if len(epochs) < 2:
        raise MismatchError(f"{log.path}: is of the {antenna} antenna, of which the run has no epochs")
    table = table_of_positions(log, epochs, _trajectory_of(own, antenna, epochs))
    if table["chainage_m"].null_count() == len(table):
        raise MismatchError(f"{log.path}: has no position at the epochs of the log of {run}; give that of the same run")
    line: dict[str, Any] = own.part("line")
    if name := own.track_facts.get("file"):
        line = {**line, "track": {**own.track_facts, "file": str((run / str(name)).absolute())}}
    kept = [
        {**entry, "path": str(path.absolute())}
        for kind in ("track", "vehicle")
        for entry, path in zip(
            [entry for entry in own.entries if entry["input"] == kind], own.located(kind), strict=True
        )
    ]
    with OutputFolder(out, overwrite="replace", inputs=[Path(log.path)]) as folder:
        folder.append_parquet("positions.parquet", table)
        record = {"railfix": __version__, "inputs": [*kept, fingerprint("positions", Path(log.path))], "line": line}
        folder.write_json("run.json", record)
        folder.commit({"railfix": __version__})


def _trajectory_of(run: RunFolder, antenna: str, epochs: pl.DataFrame) -> Trajectory:
    """Return the trajectory on which the run's positions of an antenna lie."""
    unknown = np.full(len(epochs), np.nan)
    answers = Answers(
        chainage_m=floats(epochs, "chainage_m"),
        conventional_chainage_m=unknown,
        ecef_m=_ecef(epochs),
        reference_chainage_m=unknown,
        reference_ecef_m=np.full((len(epochs), 3), np.nan),
    )
    return find_trajectory(run, antenna, answers, TrackFiles())[0]


def _ecef(table: pl.DataFrame) -> Floats:
    return np.stack([floats(table, name) for name in ("x_m", "y_m", "z_m")], axis=1)


def write_rtklib_single_point(inputs: RunInputs, config: Config, out: Path) -> str | None:
    """Compute RTKLIB's single point of the front antenna's log into a ``.pos`` file.

    With the elevation mask and the constellations of the settings and the broadcast models; its own checks (chi-square
    test of the residuals, dilution of precision) are its defaults.

    Returns
    -------
    str or None
        A sentence on why there is no file.
    """
    program = shutil.which(RTKLIB_PROGRAM)
    if program is None:
        return f"no row of RTKLIB: {RTKLIB_PROGRAM} (Debian package rtklib) is not installed"
    if any(is_receiver_log(head_of(path)) for path in inputs.front):
        return "no row of RTKLIB: the log is not RINEX (railfix convert makes it so)"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = [*_unpacked(inputs.front, folder, "obs"), *_unpacked(inputs.nav, folder, "nav")]
        (folder / "single.conf").write_text(
            f"pos1-posmode=single\npos1-frequency=l1\npos1-elmask={config.elevation.mask_deg:g}\npos1-ionoopt=brdc\n"
            f"pos1-tropopt=saas\npos1-sateph=brdc\npos1-navsys={sum(_SYSTEMS[name] for name in config.systems)}\n"
            "out-solformat=xyz\nout-timesys=gpst\nout-timeform=hms\nout-timendec=6\n"
        )
        command = [program, "-k", str(folder / "single.conf"), "-o", str(out), *map(str, files)]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=_LONGEST_S)
        except (subprocess.SubprocessError, OSError) as error:
            return f"no row of RTKLIB: {RTKLIB_PROGRAM} failed ({type(error).__name__})"
    if not out.is_file() or all(line.startswith("%") for line in out.read_text().splitlines()):
        return f"no row of RTKLIB: {RTKLIB_PROGRAM} found no position"
    return None


def _unpacked(paths: Sequence[Path], folder: Path, kind: str) -> list[Path]:
    """Write files uncompressed, as RTKLIB reads them; return where."""
    written = [folder / f"{number}.{kind}" for number in range(len(paths))]
    for path, target in zip(paths, written, strict=True):
        target.write_bytes(read_bytes(path))
    return written
