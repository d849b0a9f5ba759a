"""Pictures of runs."""

from railfix.report.picture import RunPicture, draw_run

__all__ = ["RunPicture", "draw_run"]
