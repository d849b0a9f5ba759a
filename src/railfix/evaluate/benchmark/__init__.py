"""Benchmark: cases that others can run, and positions of other programs judged by the same code."""

from railfix.evaluate.benchmark.cases import Case, read_case, read_cases, write_case
from railfix.evaluate.benchmark.table import BENCHMARK_COLUMNS, markdown_table, run_benchmark

__all__ = [
    "BENCHMARK_COLUMNS",
    "Case",
    "markdown_table",
    "read_case",
    "read_cases",
    "run_benchmark",
    "write_case",
]
