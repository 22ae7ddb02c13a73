"""Reports: the picture of a run, and progress in a terminal.

Everything is drawn from records and nothing else. Start with `report.py`.
"""
