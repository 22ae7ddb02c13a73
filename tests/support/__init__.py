"""What tests share: drawn maps, missions, records, processes, faults, teams, strategies and plain references.

Start with `missions.py`. A fixture that only one folder uses is in the `conftest.py` of that folder.
"""
