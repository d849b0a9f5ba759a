"""A page on a network of tracks: plan with switches, faults and the positions of a run; its tracks as a table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from railfix.core.files import write_whole
from railfix.core.tables import Table, number, share
from railfix.report.charts_page import charts_page
from railfix.report.plots.network import network_plan
from railfix.report.tables import Block, Notes, Sentence
from railfix.track.network import Network
from railfix.track.network_check import NetworkQuality
from railfix.track.network_match import Matched, PlanLog

#: Tracks that are listed at most.
_LISTED: Final = 5_000


def write_network_page(
    network: Network, quality: NetworkQuality, out: Path, *, run: tuple[PlanLog, Matched] | None = None
) -> None:
    """Write a page on a network, with the positions of a run in its frame; it opens without an internet connection.

    Raises
    ------
    OutputError
        The page cannot be written.
    """
    title = f"{quality.tracks:,} tracks, {quality.length_m / 1e3:,.1f} km, {quality.switches:,} switches"
    write_whole(
        out, charts_page(title, [network_plan(network, quality, run)], _tables(network, quality, run)), what="page"
    )


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
