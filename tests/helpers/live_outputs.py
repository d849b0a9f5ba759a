"""Messages of results outside a session."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline_cases import clean_trajectories
from railfix.live.engine import LiveOutput
from railfix.live.message import create_message, locate_train
from railfix.live.settings import LiveSettings
from railfix.live.train_ends import TrainFrame
from railfix.pipeline.results import Result
from railfix.track.trajectory import Trajectory


def output_of(
    result: Result, settings: LiveSettings | None = None, trajectories: Mapping[str, Trajectory] | None = None
) -> LiveOutput:
    """What an engine sends of a result, its train's front end looking as at the start."""
    settings = settings or LiveSettings()
    frame = TrainFrame.of(clean_trajectories() if trajectories is None else trajectories, settings)
    place = locate_train(result, frame)
    message = create_message(result, place, settings, frame, frame.running)
    return LiveOutput(message=message, result=result, place=place)
