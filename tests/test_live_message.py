"""What a live message says of a place that sensors carry (requirement A8)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline_cases import clean_trajectories, demo_observations
from railfix.core.reasons import Status
from railfix.io.rinex import read_navigation
from railfix.io.train_message import MessageStatus
from railfix.live.message import message_of
from railfix.live.settings import LiveSettings
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.simulate.demo_data import demo_files
from railfix.tracking import TrackStatus


@pytest.mark.requirement("A8")
def test_no_bound_of_a_position_that_failed_a_check_goes_out_as_coasting() -> None:
    """Codes that contradict the place after a tunnel are left out, though the single epoch has a level."""
    processor = EpochProcessor(
        parse_config({"filter": "track", "tracking": {"level": "off"}}),
        {"front": clean_trajectories()["front"]},
        navigation=read_navigation(demo_files()["nav"]),
    )
    result, _ = processor.process({"front": demo_observations()["front"][:30:10]})
    antenna, track = result.antennas["front"], result.fusion["front"]
    assert antenna.status[-1] == Status.OK
    tracked = replace(track.tracked, status=np.full(3, TrackStatus.COASTING, dtype=np.int8))
    for single, expected in ((Status.OK, MessageStatus.COASTING), (Status.INCONSISTENT, MessageStatus.DOUBTFUL)):
        changed = replace(
            result,
            antennas={"front": replace(antenna, status=np.full(3, single, dtype=np.int8))},
            fusion={"front": replace(track, tracked=tracked)},
        )
        message = message_of(changed, LiveSettings(), sequence=0, sent_ns=0)
        assert message.status is expected
        assert (message.over_cm is None) == (expected is MessageStatus.DOUBTFUL)
