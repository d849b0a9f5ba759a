"""Settings of the simulated SBAS."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from railfix.simulate.settings import NotNegative, Positive, ScenarioSettings, Share


class SbasSettings(ScenarioSettings):
    """SBAS that corrects GPS and the ionosphere, or on L5 ionosphere-free codes of GPS and Galileo."""

    band: Literal["L1", "L5"] = "L1"  #: L5 needs receivers with ``signals_per_satellite = 2, second = "L5"``.
    prn: Annotated[int, Field(ge=120, le=158)] = 137
    latency_s: NotNegative = 4.0  #: Corrections are those of so much before the first bit of their message.
    #: Indicators of the accuracy of all satellites and grid points, as sent.
    udrei: Annotated[int, Field(ge=0, le=13)] = 5
    givei: Annotated[int, Field(ge=0, le=14)] = 9
    dfrei: Annotated[int, Field(ge=0, le=14)] = 5  #: The same on L5.
    #: Errors of the service's own estimates: white, of each fast correction, each axis, each grid delay.
    clock_sigma_m: NotNegative = 0.0
    orbit_sigma_m: NotNegative = 0.0
    delay_sigma_m: NotNegative = 0.0
    #: Grid points so far from the line's first point, in latitude and longitude, are in the mask.
    grid_radius_deg: Positive = 25.0
    #: A fault larger than this sets the satellite to "do not use" after this time.
    alert_m: Positive = 10.0
    alert_s: NotNegative = 6.0
    lost_chance: Share = 0.0  #: Probability that a message is not received.
    #: The messages begin so long before the run, so that all corrections are there at its start.
    lead_s: NotNegative = 300.0
