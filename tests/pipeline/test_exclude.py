"""The setting `exclude`: as if the log had not the satellites."""

from __future__ import annotations

import numpy as np
import pytest

import railfix
from pipeline_cases import demo_observations
from railfix.core.errors import SettingsError
from railfix.core.reasons import Reason
from railfix.pipeline.config import parse_config


def test_excluded_satellites_are_as_if_they_were_not_there() -> None:
    files, log = railfix.demo_files(), demo_observations()["front"][:40]
    path = {"front": railfix.Trajectory.from_antenna_path(railfix.read_track(files["track"]))}
    navigation = railfix.read_navigation(files["nav"])
    kept = [name for name in np.unique(log.satellite).tolist() if name[0] != "E" and name != "G06"]
    excluding = parse_config({"filter": "track", "exclude": ["G06", "E"]})
    found, without = (
        railfix.EpochProcessor(config, path, navigation=navigation).process({"front": part})[0]
        for config, part in ((excluding, log), (parse_config({"filter": "track"}), log[:, kept]))
    )
    np.testing.assert_array_equal(found["front"].arc_m, without["front"].arc_m)
    np.testing.assert_array_equal(found.fusion["front"].tracked.arc_m, without.fusion["front"].tracked.arc_m)
    out = np.isin(found["front"].satellite, ["G06"]) | np.char.startswith(found["front"].satellite, "E")
    observed = np.isfinite(log.code_m[:, out])
    assert (found["front"].reason[:, out][observed] == Reason.EXCLUDED_BY_SETTING).all()
    assert not (found["front"].reason[:, ~out] & Reason.EXCLUDED_BY_SETTING).any()


@pytest.mark.parametrize("name", ["G7", "X", "g07", "G07 "])
def test_a_name_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(SettingsError, match="exclude"):
        parse_config({"exclude": [name]})
