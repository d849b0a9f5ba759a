"""The report on runs: one page of HTML with every table and picture, that opens without a network."""

from railfix.report.page import report_page, write_page, write_report
from railfix.report.runs import ReportedRun, read_runs

__all__ = ["ReportedRun", "read_runs", "report_page", "write_page", "write_report"]
