"""Charts of networks of tracks, map quality, surveyed lines, and track probabilities of a train at rest."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.report.plots.chart import BLACK, BLUE, GREEN, GREY, ORDERED, RED, Chart, Curve, Layer, Marks, Points
from railfix.report.plots.draw import draw_figure, save_figure
from railfix.report.plots.line import LocalFrame
from railfix.track.network import Network, end_points

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from railfix.run.locate import Surveyed
    from railfix.run.which_track import TrackDecision
    from railfix.track import TrackQuality
    from railfix.track.network_match import Matched, PlanLog
    from railfix.track.network_read import NetworkQuality

#: Maximum number of track points that are drawn; in larger networks, every n-th point and the ends of tracks are drawn.
_DRAWN: Final = 200_000
#: Maximum number of tracks that are named in the plan.
_NAMED: Final = 400
#: Margin of the view around a run, relative to the run's larger extent; minimum margin [m]; distance of a track's name
#: from the track, relative to the extent of the view.
_MARGIN, _LEAST_VIEW_M, _BESIDE = 0.12, 100.0, 0.03
_KINDS: Final = {"gap": RED, "joint": RED, "kink": "#e08e0b", "too near": "#7b3294", "dead end": GREY}
#: Classes of matched positions: lower limit of the track probability, and colour.
_CLASSES: Final = ((0.99, ORDERED[0]), (0.9, ORDERED[1]), (0.5, ORDERED[3]), (0.0, ORDERED[4]))


def plot_network(
    network: Network,
    path: str | PathLike[str],
    *,
    quality: NetworkQuality | None = None,
    run: tuple[PlanLog, Matched] | None = None,
) -> None:
    """Write `network_plan` as a PNG or SVG file; raise OutputError if the file cannot be written."""
    save_figure(draw_figure(network_plan(network, quality, run)), path)


def network_plan(network: Network, quality: NetworkQuality | None, run: tuple[PlanLog, Matched] | None) -> Chart:
    """Return a plan of the tracks with switches and names, findings of the map check, and the positions of a run."""
    latitude, longitude = _degrees(network)
    frame = network_frame(network)
    nth = max(1, len(latitude) // _DRAWN)
    rows, breaks = _thin(network, nth)
    east, north = np.insert(frame.to_plane(latitude[rows], longitude[rows]), breaks, np.nan, axis=0).T
    layers: list[Layer] = [Curve(label="tracks", colour=BLUE, x=east, y=north, width=1.2)]
    ends, _ = end_points(network)
    stems = _switches(network)
    if len(stems):
        east, north = frame.plane(ends[stems[:, 0], stems[:, 1]]).T
        layers.append(Points(label="switches", colour=GREEN, x=east, y=north, shape="square", size=4.0))
    for kind, colour in _KINDS.items():
        found = [f for f in quality.findings if f.kind == kind] if quality is not None else []
        if found:
            degrees = np.array([(f.latitude_deg, f.longitude_deg) for f in found])
            east, north = frame.to_plane(*degrees.T).T
            layers.append(Points(label=kind, colour=colour, x=east, y=north, shape="cross", size=7.0))
    if run is not None:
        layers += _positions(frame, *run)
    view = None if run is None else _view(frame, run[0])
    if run is not None and view is not None:
        layers.append(_names_beside(network, frame, run[1], view))
    elif len(network.tracks) <= _NAMED:
        middle = (network.first_point[:-1] + network.first_point[1:]) // 2
        east, north = frame.to_plane(latitude[middle], longitude[middle]).T
        layers.append(Marks(label="names", colour=BLACK, x=east, y=north, words=network.names, place="on"))
    caption = f"Origin at latitude and longitude {frame.latitude_deg:.5f}, {frame.longitude_deg:.5f}."
    if nth > 1:
        caption += f" Every {nth}th point and the ends of each track are drawn."
    return Chart(
        name="network", title="Tracks", caption=caption, x_label="east [m]", y_label="north [m]", layers=tuple(layers),
        equal=True, x_range=view and view[0], y_range=view and view[1],
    )  # fmt: skip


def _degrees(network: Network) -> tuple[Floats, Floats]:
    """Return the latitudes and longitudes of the points of all tracks [deg]."""
    latitude, longitude = (
        np.concatenate([getattr(t, name) for t in network.tracks]) for name in ("latitude_deg", "longitude_deg")
    )
    return latitude, longitude


def network_frame(network: Network) -> LocalFrame:
    """Return the local frame for the plan of a network, at the median of its points."""
    latitude, longitude = _degrees(network)
    return LocalFrame.at(float(np.median(latitude)), float(np.median(longitude)))


def _view(frame: LocalFrame, log: PlanLog) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return the ranges of the east and north axes [m] around the positions of a run; None without positions."""
    known = np.isfinite(log.latitude_deg)
    if not known.any():
        return None
    place = frame.to_plane(log.latitude_deg[known], log.longitude_deg[known])
    low, high = place.min(axis=0), place.max(axis=0)
    margin = max(_MARGIN * float((high - low).max()), _LEAST_VIEW_M)
    ranges = [(float(a - margin), float(b + margin)) for a, b in zip(low, high, strict=True)]
    return ranges[0], ranges[1]


def _names_beside(
    network: Network, frame: LocalFrame, matched: Matched, view: tuple[tuple[float, float], tuple[float, float]]
) -> Marks:
    """Return the names of the tracks of a run; each name is next to the middle position on the track, on alternating
    sides.
    """
    passed = dict.fromkeys(matched.track[matched.track >= 0].tolist())
    places = [np.flatnonzero(matched.track == track) for track in passed][:_NAMED]
    rows = np.array([own[len(own) // 2] for own in places], dtype=np.intp)
    track = matched.track[rows]
    points, ahead, _ = network.course_on(track, matched.chainage_m[rows])
    (x, y), (dx, dy) = frame.plane(points).T, (ahead @ frame.axes[:2].T).T
    span = max(high - low for low, high in view)
    # a name is wider than high, and is therefore placed farther away from tracks that run north-south
    away = np.where(np.arange(len(rows)) % 2, -1.0, 1.0) * span * (_BESIDE * np.abs(dx) + 2.0 * _BESIDE * np.abs(dy))
    words = tuple(network.names[t] for t in track)
    return Marks(label="names", colour=BLACK, x=x + away * dy, y=y - away * dx, words=words, place="on")


def _thin(network: Network, nth: int) -> tuple[Indices, Indices]:
    """Return the indices of every n-th point and the last point of each track.

    Also return the indices in this array at which all tracks but the first begin.
    """
    first, last = network.first_point[:-1], network.first_point[1:] - 1
    track = np.repeat(np.arange(len(first)), last - first + 1)
    place = np.arange(len(track)) - first[track]
    kept = np.flatnonzero((place % nth == 0) | (np.arange(len(track)) == last[track]))
    return kept, np.flatnonzero(np.diff(track[kept])) + 1


def _switches(network: Network) -> Indices:
    """For each switch, return its stem: index of the track and of the track's end, shape (n, 2)."""
    stems = sorted(end for end, others in network.passages.items() if len(others) > 1)
    return np.array(stems, dtype=np.intp).reshape(-1, 2)


def _positions(frame: LocalFrame, log: PlanLog, matched: Matched) -> list[Layer]:
    """Return one layer of positions for each class of track probability, and one for positions without a track."""
    east, north = frame.to_plane(log.latitude_deg, log.longitude_deg).T
    on, layers, above = matched.track >= 0, [], np.inf
    for low, colour in _CLASSES:
        words = f"from {low:g}" if above == np.inf else f"{low:g} to {above:g}" if low else f"below {above:g}"
        rows = on & (matched.probability >= low) & (matched.probability < above)
        layers.append(Points(label=f"position, track probability {words}", colour=colour, x=east[rows], y=north[rows]))
        above = low
    off = ~on & np.isfinite(log.latitude_deg)
    layers.append(Points(label="position without a track", colour=BLACK, x=east[off], y=north[off], shape="ring"))
    return [layer for layer in layers if len(layer.x)]


_COLOURS: Final = {"error": "#c1272d", "warning": "#e08e0b"}
_LINE: Final = "#1f4e79"
#: Panel in which findings of each kind are marked; findings of other kinds are marked only in the plan.
_PANELS: Final = {
    "mid-chord": "mid-chord",
    "duplicate": "spacing",
    "near duplicate": "spacing",
    "spacing": "spacing",
    "kink": "turn",
    "gradient": "gradient",
    "gradient attribute": "gradient",
    "height spike": "gradient",
    "cant": "cant",
    "radius": "cant",
    "radius side": "cant",
}


def plot_track_quality(quality: TrackQuality, path: str | PathLike[str]) -> None:
    """Write a picture of the plan of a track, and of the quantities of its quality check over chainage.

    The quantities are mid-chord deviation, point spacing, turns, gradient and cant.

    The findings of the map check are marked. The file is PNG or SVG; raise OutputError if it cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 14), layout="constrained")
    names = ("mid-chord", "spacing", "turn", "gradient", "cant")
    grid = figure.add_gridspec(1 + len(names), 1, height_ratios=[2.6] + [1.0] * len(names))
    _draw_plan(figure.add_subplot(grid[0]), quality)
    panels = {name: figure.add_subplot(grid[i + 1]) for i, name in enumerate(names)}
    _draw_panels(panels, quality)
    save_figure(figure, path)


def _draw_plan(axes: Axes, quality: TrackQuality) -> None:
    track = quality.track
    east, north = LocalFrame.around(track.ecef_m[:1]).plane(track.ecef_m).T
    axes.plot(east, north, "-", color=_LINE, linewidth=1.2)
    axes.plot(east[0], north[0], "o", color=_LINE, markersize=6, label="start")
    for severity, found in (("error", quality.errors), ("warning", quality.warnings)):
        at = [finding.first for finding in found]
        if at:
            axes.plot(
                east[at], north[at], "x", color=_COLOURS[severity], markersize=7, label=f"{severity}s ({len(at)})"
            )
    title = f"{track.name}: {len(track)} points, {track.chainage_m[-1]:,.0f} m"
    axes.set(xlabel="east of the first point [m]", ylabel="north [m]", title=title)
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best", fontsize=8)
    axes.grid(visible=True, alpha=0.3)


def _draw_panels(panels: dict[str, Axes], quality: TrackQuality) -> None:
    track, geometry, limits = quality.track, quality.geometry, quality.limits
    along = track.chainage_m
    middle = (along[1:] + along[:-1]) / 2.0
    curves = {
        "mid-chord": (middle, np.abs(geometry.mid_chord_m), "chord from arc [m]", limits.mid_chord_m),
        "spacing": (middle, geometry.spacing_m, "spacing [m]", limits.spacing_m),
        "turn": (along, geometry.turn_deg, "turn at a point [deg]", None),
        "gradient": (middle, geometry.gradient_permille, "gradient [per mille]", None),
        "cant": (along, 1e3 * track.cant_m, "cant [mm]", None),
    }
    for name, (x, y, label, limit) in curves.items():
        axes = panels[name]
        if np.isfinite(y).any():
            axes.plot(x, y, "-", color=_LINE, linewidth=0.9)
        else:
            axes.text(0.5, 0.5, "not in the map", transform=axes.transAxes, ha="center", va="center", color="0.4")
        if limit is not None and np.nanmax(y, initial=0.0) > limit / 4.0:
            axes.axhline(limit, color=_COLOURS["error"], linewidth=0.8, linestyle="--")
        axes.set_ylabel(label, fontsize=8)
        axes.set_xlim(along[0], along[-1])
        axes.grid(visible=True, alpha=0.3)
    stated = track.gradient_permille
    if np.isfinite(stated).any():
        panels["gradient"].plot(along, stated, "-", color="0.5", linewidth=0.9, label="stated in the map")
        panels["gradient"].legend(loc="best", fontsize=7)
    for finding in quality.findings:
        if finding.kind in _PANELS:
            last = max(along[finding.last], along[finding.first] + 0.002 * along[-1])
            colour = _COLOURS[finding.severity]
            panels[_PANELS[finding.kind]].axvspan(finding.chainage_m, last, color=colour, alpha=0.35, linewidth=0)
    list(panels.values())[-1].set_xlabel("chainage [m]")


def plot_survey(surveyed: Surveyed, path: str | PathLike[str]) -> None:
    """Write a picture of a survey: a plan of positions and map, and charts of height and standard deviations.

    Raise OutputError if the file cannot be written.
    """
    from matplotlib.figure import Figure

    survey, track = surveyed.survey, surveyed.survey.track
    frame = LocalFrame.around(track.ecef_m[:1])
    figure = Figure(figsize=(10, 12), layout="constrained")
    grid = figure.add_gridspec(3, 1, height_ratios=[3.0, 1.0, 1.0])
    plan, height, sigma = (figure.add_subplot(grid[i]) for i in range(3))
    for number, run in enumerate(surveyed.runs):
        plan.plot(
            *frame.plane(run.ecef_m).T,
            ".",
            color=_COLOURS["error"],
            markersize=2,
            label="positions" if not number else None,
        )
    east, north = frame.plane(track.ecef_m).T
    plan.plot(east, north, color=_LINE, label="map")
    margin = 0.05 * max(float(np.ptp(east)), float(np.ptp(north))) + 20.0
    plan.set(
        xlim=(east.min() - margin, east.max() + margin),
        ylim=(north.min() - margin, north.max() + margin),
        xlabel="east of the first point [m]",
        ylabel="north [m]",
        title=track.name,
    )
    plan.set_aspect("equal", adjustable="box")
    plan.legend(loc="best")
    chainage = track.chainage_m
    low, high = track.height_m - survey.sigma_height_m, track.height_m + survey.sigma_height_m
    height.fill_between(chainage, low, high, color=_LINE, alpha=0.2)
    height.plot(chainage, track.height_m, color=_LINE)
    height.set(ylabel="height, one sigma [m]")
    sigma.plot(chainage, survey.sigma_plan_m, color=_LINE, label="across")
    sigma.plot(chainage, survey.sigma_height_m, color=_COLOURS["error"], label="height")
    sigma.set(xlabel="chainage [m]", ylabel="standard deviation [m]", ylim=(0.0, None))
    sigma.legend(loc="best")
    for panel in (height, sigma):
        panel.set_xlim(chainage[0], chainage[-1])
        panel.grid(alpha=0.3)
    save_figure(figure, path)


def plot_track_decision(decision: TrackDecision, path: str | PathLike[str], *, risk: float) -> None:
    """Write a picture over time: probability of each track, its complement to 1, and the allowed risk."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), dpi=120)
    above, below = figure.subplots(2, 1, sharex=True)
    shares = np.array([p.probability for p in decision.posteriors])
    for k, name in enumerate(decision.posteriors[-1].names):
        if shares[:, k].max() > 1e-3:
            above.plot(decision.seconds, shares[:, k], marker=".", label=name)
            below.semilogy(decision.seconds, np.maximum(1.0 - shares[:, k], 1e-12), marker=".", label=name)
    below.axhline(risk, color="black", linestyle="--", label="allowed risk")
    above.set(ylabel="probability", title=f"track: {decision.track}")
    below.set(ylabel="probability of another track", xlabel="time at rest [s]")
    below.legend(loc="best", fontsize=7)
    save_figure(figure, path)
