"""Sweeps: `kantor sweep` runs many seeds of many variants and writes one table.

`plan.py` lists the runs, `run.py` executes them and resumes, `table.py`, `summary.py` and `plot.py` present the result.
Start with `plan.py`.
"""
