"""Observers of a run: journal, metrics, checkers and progress, called in a declared order.

`recording.py` is the pipeline: it decodes each record once and calls its observers. An observer reads records and
nothing else. Start with `recording.py`.
"""
