"""Chart of the time that a run took (P1 figure 13)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from railfix.core.timescale import seconds
from railfix.report.plots.chart import BLUE, GREY, Chart, Curve, Points


def processing_time(chunks: Mapping[str, Sequence[Any]], *, title: str = "Time an epoch") -> Chart:
    """Time an epoch over the run, the mean of each chunk; of ``chunks`` of ``run.json``."""
    time = np.array([str(t) for t in chunks["first_epoch_gpst"]], dtype="datetime64[ns]")
    epochs = np.array(chunks["epochs"], dtype=np.float64)
    spent = np.array(chunks["positioning_s"], dtype=np.float64)
    start = time.min() if len(time) else np.datetime64(0, "ns")
    x = seconds(time - start)
    mean_ms = 1e3 * spent / np.maximum(epochs, 1.0)
    whole = 1e3 * spent.sum() / max(epochs.sum(), 1.0)
    return Chart(
        name="processing-time",
        title=title,
        caption=f"Mean of each of {len(x):,} chunks of up to {epochs.max(initial=0):,.0f} epochs of all antennas, at "
        f"the time of the first; reading and writing not included. Over the run {whole:.3f} ms an epoch and antenna. A "
        "chunk is positioned as a whole: live, epoch by epoch, each takes longer.",
        x_label="GPS time",
        y_label="ms an epoch",
        layers=(
            Curve(label="", colour=GREY, x=x, y=mean_ms, width=1.0),
            Points(label="mean of a chunk", colour=BLUE, x=x, y=mean_ms, size=6.0),
        ),
        start=start,
        y_range=(0.0, 1.15 * float(mean_ms.max(initial=0.1))),
    )
