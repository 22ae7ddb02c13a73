"""Reproduction of the papers: `kantor reproduce` prints a verdict beside each published number.

A figure names the runs that it needs, its claims and its drawing; `papers.py` lists them, `run.py` executes them.
The algorithms themselves are in the packages below. Start with `figure.py`.
"""
