"""A page on a network of tracks: plan with switches, faults and the positions of a run; its tracks as a table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.core.files import write_whole
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.report.content import Block, Notes, Sentence, Table, number, share
from railfix.report.page import charts_page
from railfix.report.plots.chart import BLACK, BLUE, GREEN, GREY, ORDERED, RED, Chart, Layer, Line, Marks, Points
from railfix.track.network import Network, end_points
from railfix.track.network_check import NetworkQuality
from railfix.track.network_match import Matched, PlanLog

#: Points of tracks that are drawn at most; of larger networks every n-th one and the ends.
_DRAWN: Final = 200_000
#: Tracks that are named in the plan, and listed, at most.
_NAMED: Final = 400
_LISTED: Final = 5_000
_KINDS: Final = {"gap": RED, "joint": RED, "kink": "#e08e0b", "too near": "#7b3294", "dead end": GREY}
#: Positions by the probability of their track: at least this, and the colour.
_CLASSES: Final = ((0.99, ORDERED[0]), (0.9, ORDERED[1]), (0.5, ORDERED[3]), (0.0, ORDERED[4]))


def write_network_page(
    network: Network, quality: NetworkQuality, out: Path, *, run: tuple[PlanLog, Matched] | None = None
) -> None:
    """Write a page on a network that loads nothing and opens without an internet connection.

    Parameters
    ----------
    network : Network
    quality : NetworkQuality
    out : Path
    run : (PlanLog, Matched), optional
        Positions on the network, in its frame.

    Raises
    ------
    OutputError
        The page cannot be written.
    """
    title = f"{quality.tracks:,} tracks, {quality.length_m / 1e3:,.1f} km, {quality.switches:,} switches"
    write_whole(out, charts_page(title, [_plan(network, quality, run)], _tables(network, quality, run)), what="page")


def _plan(network: Network, quality: NetworkQuality, run: tuple[PlanLog, Matched] | None) -> Chart:
    latitude, longitude = (
        np.concatenate([getattr(t, name) for t in network.tracks]) for name in ("latitude_deg", "longitude_deg")
    )
    at = (float(np.median(latitude)), float(np.median(longitude)))
    nth = max(1, len(latitude) // _DRAWN)
    rows, breaks = _thinned(network, nth)
    layers: list[Layer] = [_line("tracks", BLUE, _local(at, latitude[rows], longitude[rows]), breaks)]
    ends, _ = end_points(network)
    axes = enu_axes(*at)[:2]
    stems = _switches(network)
    if len(stems):
        east, north = ((ends[stems[:, 0], stems[:, 1]] - ecef_from_geodetic(*at, 0.0)) @ axes.T).T
        layers.append(Points(label="switches", colour=GREEN, x=east, y=north, shape="square", size=4.0))
    for kind, colour in _KINDS.items():
        found = [f for f in quality.findings if f.kind == kind]
        if found:
            place = _local(at, np.array([f.latitude_deg for f in found]), np.array([f.longitude_deg for f in found]))
            layers.append(Points(label=kind, colour=colour, x=place[0], y=place[1], shape="cross", size=7.0))
    if run is not None:
        layers += _positions(at, *run)
    if len(network.tracks) <= _NAMED:
        middle = (network.first_point[:-1] + network.first_point[1:]) // 2
        east, north = _local(at, latitude[middle], longitude[middle])
        layers.append(Marks(label="names", colour=BLACK, x=east, y=north, words=network.names, place="on"))
    caption = f"Plan about {at[0]:.5f}, {at[1]:.5f}."
    if nth > 1:
        caption += f" Every {nth}th point of a track and its ends are drawn."
    return Chart(
        name="network", title="Tracks", caption=caption, x_label="east [m]", y_label="north [m]", layers=tuple(layers),
        equal=True,
    )  # fmt: skip


def _local(at: tuple[float, float], latitude_deg: Floats, longitude_deg: Floats) -> tuple[Floats, Floats]:
    """East and north of a place on the ellipsoid [m]."""
    plan = ecef_from_geodetic(latitude_deg, longitude_deg, np.zeros(len(latitude_deg))) - ecef_from_geodetic(*at, 0.0)
    east, north = (plan @ enu_axes(*at)[:2].T).T
    return east, north


def _thinned(network: Network, nth: int) -> tuple[Indices, Indices]:
    """Every n-th point of each track and its last one, and where in them a new track begins."""
    first, last = network.first_point[:-1], network.first_point[1:] - 1
    track = np.repeat(np.arange(len(first)), last - first + 1)
    place = np.arange(len(track)) - first[track]
    kept = np.flatnonzero((place % nth == 0) | (np.arange(len(track)) == last[track]))
    return kept, np.flatnonzero(np.diff(track[kept])) + 1


def _line(label: str, colour: str, place: tuple[Floats, Floats], breaks: Indices) -> Line:
    east, north = (np.insert(values, breaks, np.nan) for values in place)
    return Line(label=label, colour=colour, x=east, y=north, width=1.2)


def _switches(network: Network) -> Indices:
    """Track and end of each stem of a switch, shape (n, 2)."""
    ends = np.array(
        [
            pair
            for link in network.links
            if link.navigable
            for pair in ((link.first, link.first_end), (link.second, link.second_end))
        ],
        dtype=np.intp,
    ).reshape(-1, 2)
    stems, count = np.unique(ends, axis=0, return_counts=True)
    return np.asarray(stems[count > 1], dtype=np.intp)


def _positions(at: tuple[float, float], log: PlanLog, matched: Matched) -> list[Layer]:
    """Positions in classes of the probability of their track, and those on none."""
    east, north = _local(at, log.latitude_deg, log.longitude_deg)
    on, layers, above = matched.track >= 0, [], np.inf
    for low, colour in _CLASSES:
        rows = on & (matched.probability >= low) & (matched.probability < above)
        layers.append(
            Points(label=f"position, probability of its track from {low:g}", colour=colour, x=east[rows], y=north[rows])
        )
        above = low
    off = ~on & np.isfinite(log.latitude_deg)
    layers.append(Points(label="position on no track", colour=BLACK, x=east[off], y=north[off], shape="ring"))
    return [layer for layer in layers if len(layer.x)]


def _tables(network: Network, quality: NetworkQuality, run: tuple[PlanLog, Matched] | None) -> Sequence[Block]:
    beside: dict[tuple[int, int], list[str]] = {}
    for link in network.links:
        if link.navigable:
            beside.setdefault((link.first, link.first_end), []).append(network.names[link.second])
            beside.setdefault((link.second, link.second_end), []).append(network.names[link.first])
    seen = np.zeros(len(network.tracks), dtype=np.int64)
    blocks: list[Block] = [
        Sentence(
            f"{quality.ends:,} ends without a connection, {quality.parts:,} separate part(s), "
            f"{sum(f.kind != 'dead end' for f in quality.findings):,} findings."
        )
    ]
    if run is not None:
        matched = run[1]
        on = matched.track >= 0
        np.add.at(seen, matched.track[on], 1)
        blocks.append(
            Sentence(
                f"{len(on):,} positions, {share(float(on.mean()), 1)} on a track, "
                f"{share(float((np.abs(matched.offset_m) <= 5.0).mean()), 1)} within 5 m of it, "
                f"{share(float((matched.probability < 0.9).mean()), 1)} with a probability below 0.9."
            )
        )
    if network.notes:
        blocks.append(Notes("Notes", network.notes))
    if quality.findings:
        blocks.append(
            Table(
                name="findings",
                head=("kind", "latitude", "longitude", "finding"),
                rows=[
                    (f.kind, f"{f.latitude_deg:.6f}", f"{f.longitude_deg:.6f}", f.sentence)
                    for f in quality.findings[:_LISTED]
                ],
                caption=f"Findings: {len(quality.findings):,}",
                numeric=(1, 2),
            )
        )
    blocks.append(
        Table(
            name="tracks",
            head=("track", "length m", "before its first point", "after its last point", "positions"),
            rows=[
                (
                    name,
                    number(float(network.length_m[k]), 1),
                    ", ".join(beside.get((k, 0), [])),
                    ", ".join(beside.get((k, 1), [])),
                    f"{seen[k]:,}" if run is not None else "–",
                )
                for k, name in enumerate(network.names[:_LISTED])
            ],
            caption=f"Tracks: {len(network.tracks):,}"
            + (f", the first {_LISTED:,} of them" if len(network.tracks) > _LISTED else ""),
            numeric=(1, 4),
        )
    )
    return blocks
