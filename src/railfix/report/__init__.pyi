# The names of `railfix.report`, imported at their first use (lazy-loader).

from .page import report_page, write_page, write_report
from .runs import ReportedRun, read_runs

__all__ = ["ReportedRun", "read_runs", "report_page", "write_page", "write_report"]
