"""Reports for people: the picture of a run, its printed summary, and progress in a terminal.

Everything is drawn from records and results; nothing here changes a run. `report.py` draws report.png from the
`history.py` of a run. Start with `report.py`.
"""
