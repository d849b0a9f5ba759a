"""Report on runs: one HTML page with its tables and charts, readable without a network."""

from railfix.report.page import report_page, write_page, write_report
from railfix.report.runs import ReportedRun, read_runs

__all__ = ["ReportedRun", "read_runs", "report_page", "write_page", "write_report"]
