"""``railfix map network``, ``map route`` and ``map match``: commands on networks of tracks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import polars as pl
import typer
from pydantic import model_validator

from railfix.cli.console import MOST_FINDINGS, TableConsole, show_notes, show_table
from railfix.cli.options import OverwriteOption, Without, check_outputs, from_models
from railfix.core.arrays import Floats
from railfix.core.errors import MapQualityError, MismatchError, SettingsError
from railfix.core.notebook import plural
from railfix.core.options import option
from railfix.core.settings import INPUTS, Settings
from railfix.core.staged_files import write_whole
from railfix.core.tables import plain_table
from railfix.run.inputs import ColumnNames, TrackReading
from railfix.track import check_track, write_track_csv
from railfix.track.network import Network
from railfix.track.network_match import Matched, PlanLog, match, read_plan_positions
from railfix.track.network_read import FAULTS, TOLERANCE_M, check_network, read_network
from railfix.track.network_route import Filled, Rows, fill_gaps, find_route, left_out_note
from railfix.track.quality import error_note
from railfix.track.read import track_of_segments

Maps = Annotated[list[Path], typer.Argument(metavar="MAP...", help="Map files; all their tracks form the network.")]

#: Names of the track-reading options that only `railfix run` has.
RUN_ALONE = ("reference", "cache")
#: Options for reading a map in a command that processes no run.
MapReading = Annotated[TrackReading, Without(*RUN_ALONE, "map_epoch", "plate", "jgd_parameters", "height_sigma")]


class RouteChoice(Settings):
    """Selection of a route through a network: by the names of tracks, by points, or by positions of a run."""

    tracks: str | None = option(
        "Names of tracks of the route, in order; tracks in between are added.", None, metavar="NAME,NAME..."
    )
    via: tuple[str, ...] = option(
        "Point on the route; repeat the option in the order of travel.", (), metavar="LAT,LON"
    )
    positions: Path | None = option("Log of positions of a run on the route.", None, metavar="LOG", panel=INPUTS)
    heights: Path | None = option(
        "Heights for a map without heights: a raster (GeoTIFF, ESRI ASCII grid, SRTM), a CSV table over chainage_m "
        "or kilometrage_m, or positions of a run.",
        None,
        metavar="FILE",
        panel=INPUTS,
    )

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if sum(bool(way) for way in (self.tracks, self.via, self.positions)) > 1:
            raise ValueError("give one of --tracks, --via and --positions")
        return self


class Connecting(Settings):
    """Tolerance for connecting the ends of tracks, and reference frame of the positions."""

    tolerance: float = option(
        "Distance within which ends of tracks are connected, if the file has no connections.",
        TOLERANCE_M,
        metavar="M",
        gt=0.0,
    )
    same_frame: Literal["no", "yes"] = option(
        "The positions are in the frame of the map (for example RTK), not in the frame of the satellite orbits.",
        "no",
        name="--same-frame",
    )


class MatchOptions(Settings):
    """Options of a match: cross-track error of the positions, rows to fill, and files to write."""

    sigma: float | None = option(
        "Standard deviation of the distance from the track, including the map's error; by default as "
        "stated in LOG, or else estimated from LOG, or else 4 m.",
        None,
        metavar="M",
        gt=0.0,
    )
    within: float | None = option(
        "Positions farther from all tracks are not matched; by default 30 m, or up to 100 m for large sigmas in LOG.",
        None,
        metavar="M",
        gt=0.0,
    )
    fill: Rows = option(
        "Rows that are filled along the shortest route. gaps: rows without a position between known positions; "
        "off-map: also rows whose positions are too far from every track (for example in a tunnel), including rows "
        "at the start and end of LOG.",
        "gaps",
    )
    picture: Path | None = option("Plot of network and positions (.png or .svg).", None, metavar="FILE")
    page: Path | None = option("Page to write: zoomable plan, switches, faults, tables.", None, metavar="FILE.html")


Page = Annotated[
    Path | None, typer.Option(metavar="FILE.html", help="Page to write: zoomable plan, switches, faults, tables.")
]


def _network(maps: list[Path], reading: TrackReading, connecting: Connecting) -> Network:
    return read_network(maps, reading.of_map, tolerance_m=connecting.tolerance)


@from_models
def network(
    maps: Maps,
    *,
    reading: MapReading,
    connecting: Annotated[Connecting, Without("same_frame")],
    out: Annotated[Path | None, typer.Option(metavar="PICTURE", help="Plot of the network (.png or .svg).")] = None,
    page: Page = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Check a network of tracks and print its faults.

    The command reports gaps between ends of tracks, connections whose ends do not meet, dead ends, kinks at switches,
    and tracks that are too close together for vehicles to pass.

    Example: `railfix map network tracks.gpkg --out network.png`

    Exit codes are listed in `railfix --help`; the code is 6 if the network has gaps, kinks, or connections whose
    ends do not meet.
    """
    check_outputs((out, "picture"), (page, "page"), overwrite=overwrite, inputs=maps)
    tracks = _network(maps, reading, connecting)
    quality = check_network(tracks)
    console = TableConsole()
    console.print(
        f"{quality.tracks} tracks, {quality.length_m / 1e3:,.1f} km, {quality.switches} switches, {quality.ends} ends "
        f"without connection, {plural(quality.parts, 'separate part')}"
    )
    show_notes(console, dict.fromkeys([*tracks.notes, *(n for t in tracks.tracks for n in t.notes)]))
    rows = [
        [found.kind, f"{found.latitude_deg:.6f}", f"{found.longitude_deg:.6f}", found.sentence]
        for found in quality.findings
    ]
    show_table(console, plain_table(["kind", "latitude", "longitude", "finding"], rows, texts=4), most=MOST_FINDINGS)
    if out is not None:
        from railfix.report.plots.network import plot_network

        plot_network(tracks, out, quality=quality)
        console.print(f"picture: {out}")
    if page is not None:
        from railfix.report.charts_page import write_network_page

        write_network_page(tracks, quality, page)
        console.print(f"page: {page}")
    faults = [f for f in quality.findings if f.kind in FAULTS]
    if faults:
        raise MapQualityError(f"the network has {plural(faults, 'fault')}, the first: {faults[0].sentence}")


@from_models
def route(
    maps: Maps,
    *,
    out: Annotated[Path, typer.Option(metavar="TRACK.csv", help="Track map to write.")],
    choice: RouteChoice,
    columns: ColumnNames,
    connecting: Connecting,
    reading: Annotated[TrackReading, Without(*RUN_ALONE)],
    overwrite: OverwriteOption = False,
) -> None:
    """Make the track map of one route from a network or another map file.

    The route is specified by tracks or by points on the route, or is found from the positions of a run.

    Example: `railfix map route net.gpkg --positions run.pos --heights run.pos --out route.csv`

    Exit codes are listed in `railfix --help`; the code is 5 if no route connects two positions.
    """
    files = [*maps, choice.positions, choice.heights, reading.jgd_parameters]
    check_outputs((out, "csv"), overwrite=overwrite, inputs=files)
    net = _network(maps, reading, connecting)
    log = None
    if choice.positions is not None:
        log = read_plan_positions(choice.positions, **columns.arguments)
    passed, notes = _route_tracks(net, choice, log, connecting, reading)
    track = track_of_segments(
        [net.tracks[k] for k in passed],
        heights=choice.heights,
        geoid=reading.geoid,
        height_datum=reading.height_datum,
        sigma_height_m=reading.height_sigma,
    )
    write_track_csv(track, out)
    console = TableConsole()
    console.print(f"route: {', '.join(net.names[k] for k in passed)}")
    console.print(f"{len(track)} points, {track.chainage_m[-1]:,.1f} m")
    show_notes(console, [*notes, *track.provenance.notes, *error_note(check_track(track))])
    console.print(f"track map: {out}")


def _route_tracks(
    net: Network, choice: RouteChoice, log: PlanLog | None, connecting: Connecting, reading: TrackReading
) -> tuple[list[int], list[str]]:
    """Return the indices of the tracks of the requested route in order, and notes.

    Raise SettingsError if a network of several tracks is given without --tracks, --via or --positions.
    """
    if choice.tracks:
        return net.shortest_route([net.find_index(name.strip()) for name in choice.tracks.split(",")]), []
    if choice.via:
        return net.shortest_route([_track_at(net, text) for text in choice.via]), []
    if log is None:
        if len(net.tracks) == 1:
            return [0], []
        raise SettingsError(f"the map has {len(net.tracks)} tracks; give --tracks, --via or --positions")
    log, notes = _in_frame_of(net, log, connecting, reading)
    passed, left_out = find_route(net, match(net, log), log.path)
    return passed, [*notes, *([left_out_note(net, left_out)] if left_out else [])]


def _in_frame_of(
    net: Network, log: PlanLog, connecting: Connecting, reading: TrackReading
) -> tuple[PlanLog, list[str]]:
    """Return the positions of a log in the network's reference frame, and notes on the log and the transformation."""
    if connecting.same_frame == "yes":
        return log, [*log.notes]
    moved, shift = log.transform_to(net, **reading.motion)
    return moved, [*log.notes, *shift.sentences]


def _track_at(net: Network, text: str) -> int:
    try:
        latitude, longitude = (float(v) for v in text.split(","))
    except ValueError:
        raise SettingsError(f"--via {text!r}: expected LATITUDE,LONGITUDE in degrees, for example 50.8,4.5") from None
    near = net.near(np.array([latitude]), np.array([longitude]), within_m=200.0, most=1)
    if near.track[0, 0] < 0:
        raise MismatchError(f"--via {text}: no track within 200 m")
    return int(near.track[0, 0])


@from_models
def match_command(
    maps: Maps,
    *,
    log: Annotated[Path, typer.Option(metavar="LOG", help="Positions: .pos, NMEA, GPX, or CSV with named columns.")],
    out: Annotated[Path, typer.Option(metavar="FILE.csv", help="File to write, with the positions on the network.")],
    options: MatchOptions,
    columns: ColumnNames,
    connecting: Connecting,
    reading: Annotated[TrackReading, Without(*RUN_ALONE, "height_sigma")],
    overwrite: OverwriteOption = False,
) -> None:
    """Match positions to the tracks of a network.

    For each position, the output has the most probable track, the probability of this track, the chainage on this
    track, and the second most probable track.

    Rows that have no position but are between rows with known positions are filled along the shortest route;
    `filled_bound_m` bounds the error of a filled row. The positions are transformed to the reference frame of the map
    at the epoch of the positions. For a position far from all tracks, the column `track` is empty.

    Example: `railfix map match net.gpkg --log run.pos --out matched.csv`

    Exit codes are listed in `railfix --help`.
    """
    picture, page = options.picture, options.page
    check_outputs((out, "csv"), (picture, "picture"), (page, "page"), overwrite=overwrite, inputs=[*maps, log])
    net = _network(maps, reading, connecting)
    as_read = read_plan_positions(log, **columns.arguments)
    positions, notes = _in_frame_of(net, as_read, connecting, reading)
    matched = match(net, positions, sigma_m=options.sigma, within_m=options.within)
    if not (matched.track >= 0).any():
        raise MismatchError(f"{log}: no position lies near a track of the network; provide the map of this region")
    write_whole(
        out, _write_matches(net, positions, matched, fill_gaps(net, matched, positions, rows_to_fill=options.fill))
    )
    console = TableConsole()
    on = matched.track >= 0
    console.print(
        f"{len(on)} positions, {on.sum()} on a track ({on.mean():.1%}), {(np.abs(matched.offset_m) <= 5.0).mean():.1%} "
        f"within 5 m of it; {(matched.probability < 0.9).sum()} with a probability below 0.9"
    )
    show_notes(
        console,
        dict.fromkeys([*net.notes, *(note for track in net.tracks for note in track.notes), *notes, *matched.notes]),
    )
    if picture is not None:
        from railfix.report.plots.network import plot_network

        plot_network(net, picture, run=(positions, matched))
        console.print(f"picture: {picture}")
    if page is not None:
        from railfix.report.charts_page import write_network_page

        write_network_page(net, check_network(net), page, run=(positions, matched))
        console.print(f"page: {page}")
    console.print(f"positions: {out}")


def _write_matches(net: Network, log: PlanLog, matched: Matched, filled: Filled) -> str:
    names = (*net.names, None)
    other = np.where(matched.candidates.track == matched.track[:, None], -1.0, matched.probabilities)
    rows, second = np.arange(len(other)), np.argmax(other, axis=1)
    next_probability = other[rows, second]
    next_track = np.where(next_probability > 0.0, matched.candidates.track[rows, second], -1)

    def texts(values: Floats, digits: int) -> list[str | None]:
        return [None if np.isnan(value) else f"{value:.{digits}f}" for value in values.tolist()]

    def shares(values: Floats) -> list[str]:
        return [f"{value:.6f}" for value in values.tolist()]

    columns = {
        "time_gpst": [None if np.isnat(time) else str(time) for time in log.time],
        "latitude_deg": texts(log.latitude_deg, 9),
        "longitude_deg": texts(log.longitude_deg, 9),
        "track": [names[k] for k in filled.track.tolist()],
        "chainage_m": texts(filled.chainage_m, 3),
        "kilometrage_m": texts(net.kilometrage_on(filled.track, filled.chainage_m), 3),
        "offset_m": texts(matched.offset_m, 3),
        "probability": shares(matched.probability),
        "next_track": [names[k] for k in next_track.tolist()],
        "next_probability": shares(np.maximum(next_probability, 0.0)),
        "unmapped_probability": shares(np.clip(1.0 - matched.probabilities.sum(axis=1), 0.0, 1.0)),
        "filled_bound_m": texts(filled.bound_m, 1),
    }
    return pl.DataFrame(columns, schema=dict.fromkeys(columns, pl.String)).write_csv()
