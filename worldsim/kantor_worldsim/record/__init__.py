"""The record of a run: its Structs, the journal on disk, and the columns that observers read.

The record is the only source: metrics, checkers, reports and replays read nothing else. How a run is judged
is not decided here. Start with `records.py`.
"""
