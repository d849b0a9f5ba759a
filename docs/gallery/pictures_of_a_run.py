---
jupytext:
  text_representation:
    extension: .md
    format_name: myst
kernelspec:
  display_name: Python 3
  language: python
  name: python3
---

# Pictures

What `railfix.report.plots` draws, on the demonstration. The [report](report.md) shows the same charts in a page that zooms.

```{code-cell} ipython3
%matplotlib inline
import tempfile
from pathlib import Path

import polars as pl

import railfix
from railfix.evaluate import evaluate_run
from railfix.report import plots
from railfix.run import RunOptions
from railfix.simulate.demonstration import demo_inputs, demo_truth

out = Path(tempfile.mkdtemp()) / "results"
railfix.run_files(demo_inputs(), railfix.Config(), out=out, options=RunOptions(observations="write"))
is_front = pl.col("antenna") == "front"
evaluation = evaluate_run(out, demo_truth())
errors = evaluation.epochs.filter(is_front)
positions = pl.read_parquet(out / "positions.parquet").filter(is_front)
observations = pl.scan_parquet(out / "observations.parquet").filter(is_front)
```

Plan of the line, positions coloured by protection level:

```{code-cell} ipython3
plots.plot_plan(positions, level_m=positions["protection_level_m"].to_numpy())
```

Errors over time:

```{code-cell} ipython3
plots.plot_error_over_time(errors)
```

Protection level over chainage:

```{code-cell} ipython3
plots.plot_levels_over_chainage(positions, railfix.Config().alarm_limit_m)
```

Satellites over time:

```{code-cell} ipython3
plots.plot_satellites_over_time(positions)
```

C/N0 over elevation:

```{code-cell} ipython3
plots.draw_chart(plots.cn0_over_elevation(observations)[0])
```

Range of the errors:

```{code-cell} ipython3
plots.plot_error_ranges({"front": errors})
```
