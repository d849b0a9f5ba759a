"""Carrier frequencies of channels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from railfix.core.arrays import Floats, Strings
from railfix.core.constants import CARRIER_FREQUENCY, GLONASS_STEP


def carrier_frequency_hz(
    satellite: Strings, signal: Strings, glonass_channel: Mapping[str, int] | None = None
) -> Floats:
    """Carrier frequency of each channel, shape (M,) [Hz].

    Parameters
    ----------
    satellite, signal : ndarray of str, shape (M,)
        "R05" on "1C".
    glonass_channel : mapping of str to int, optional
        Frequency channel of GLONASS satellites.

    Returns
    -------
    ndarray, shape (M,) [Hz]
        NaN where the band is not one of the constellation's, or a GLONASS channel is unknown.
    """
    channels = glonass_channel or {}
    result = np.full(len(satellite), np.nan)
    for i, (name, code) in enumerate(zip(satellite.tolist(), signal.tolist(), strict=True)):
        letter, band = name[0], code[0]
        frequency = CARRIER_FREQUENCY.get(letter, {}).get(band, np.nan)
        if letter == "R" and band in GLONASS_STEP:
            frequency += channels.get(name, np.nan) * GLONASS_STEP[band]
        result[i] = frequency
    return result


def named_frequency_hz(name: Strings, glonass_channel: Floats) -> Floats:
    """Carrier frequency by constellation and signal ("G1C") of channels, shape (..., M) [Hz].

    NaN where the signal, or the frequency channel of a GLONASS satellite (..., M), is not known.
    """
    frequency = np.full(glonass_channel.shape, np.nan)
    for text in np.unique(name).tolist():
        letter, band = text[:1], text[1:2]
        chosen = name == text
        frequency[..., chosen] = CARRIER_FREQUENCY.get(letter, {}).get(band, np.nan)
        if letter == "R" and band in GLONASS_STEP:
            frequency[..., chosen] += glonass_channel[..., chosen] * GLONASS_STEP[band]
    return frequency
