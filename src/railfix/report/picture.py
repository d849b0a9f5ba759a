"""One picture of a run: plan, errors along the line, standard deviation, satellites."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from railfix.errors import OutputError
from railfix.geodesy import enu_axes, geodetic_from_ecef

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

#: Colours that stay apart for the colour-blind (Okabe and Ito).
_LINE, _CONSTRAINED, _CONVENTIONAL = "#999999", "#0072b2", "#e69f00"
_MARKERS: Final = ("o", "s")


@dataclass(frozen=True, kw_only=True)
class RunPicture:
    """What is drawn of one antenna, T epochs.

    Attributes
    ----------
    chainage_m : ndarray, shape (T,) [m]
        Where the antenna was: the reference where there is one, otherwise the position.
    ecef_m, conventional_ecef_m : ndarray, shape (T, 3) [m]
    error_m, conventional_error_m : ndarray, shape (T,) [m]
        Along the line, positive toward its end; NaN where unknown.
    along_sigma_m : ndarray, shape (T,) [m]
    n_used : ndarray of int, shape (T,)
    """

    chainage_m: Floats
    ecef_m: Floats
    conventional_ecef_m: Floats
    error_m: Floats
    conventional_error_m: Floats
    along_sigma_m: Floats
    n_used: NDArray[np.int64]


def draw_run(path: Path, line_ecef_m: Floats, antennas: Mapping[str, RunPicture], *, title: str) -> Path:
    """Draw a run into one picture file.

    Parameters
    ----------
    path : Path
        The suffix tells the format (``.png``, ``.svg``, ``.pdf``).
    line_ecef_m : ndarray, shape (V, 3) [m]
        The track.
    antennas : mapping of str to RunPicture
    title : str

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 9), layout="constrained")
    figure.suptitle(title)
    plan, error, sigma, used = figure.subplots(2, 2).ravel()
    _draw_plan(plan, line_ecef_m, antennas)
    for marker, (name, run) in zip(_MARKERS, antennas.items(), strict=False):
        points: dict[str, Any] = {"marker": marker, "ms": 2, "ls": "none", "rasterized": True}
        error.plot(
            run.chainage_m, run.conventional_error_m, color=_CONVENTIONAL, label=f"{name}, conventional", **points
        )
        error.plot(run.chainage_m, run.error_m, color=_CONSTRAINED, label=f"{name}, on the map", **points)
        sigma.plot(run.chainage_m, run.along_sigma_m, color=_CONSTRAINED, label=name, **points)
        used.plot(run.chainage_m, run.n_used, color=_CONSTRAINED, label=name, **points)
    _label(error, "error along the line [m], + toward its end")
    _label(sigma, "standard deviation along the line [m]")
    _label(used, "satellites used")
    for axes in (sigma, used):
        axes.set_ylim(bottom=0)
    try:
        figure.savefig(path, dpi=130)
    except OSError as problem:
        raise OutputError(f"{path}: the picture cannot be written ({problem.strerror or problem})") from problem
    return path


def _draw_plan(axes: Axes, line_ecef_m: Floats, antennas: Mapping[str, RunPicture]) -> None:
    """The line and the positions in local east and north."""
    origin = line_ecef_m.mean(axis=0)
    latitude, longitude, _ = geodetic_from_ecef(origin)
    axis = enu_axes(latitude, longitude)

    def plan(ecef_m: Floats) -> Floats:
        return np.asarray((ecef_m - origin) @ axis.T)

    points: dict[str, Any] = {"ms": 2, "ls": "none", "marker": "o", "rasterized": True}
    for run in antennas.values():
        axes.plot(*plan(run.conventional_ecef_m)[:, :2].T, color=_CONVENTIONAL, **points)
    axes.plot(*plan(line_ecef_m)[:, :2].T, color=_LINE, lw=3, zorder=1)
    for run in antennas.values():
        axes.plot(*plan(run.ecef_m)[:, :2].T, color=_CONSTRAINED, **points)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.set_title("plan: grey the track, orange conventional, blue on the map", fontsize="medium")
    axes.grid(alpha=0.3)


def _label(axes: Axes, text: str) -> None:
    axes.set_xlabel("chainage [m]")
    axes.set_ylabel(text)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", markerscale=3)
