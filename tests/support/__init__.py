"""What tests share: drawn maps, missions, records, fleets of processes, strategies and plain references.

A plain reference says the same as a compiled kernel in a few obvious lines. Start with `missions.py`.
"""
