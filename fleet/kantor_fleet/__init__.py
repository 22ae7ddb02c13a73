"""The kantor command: fleets, runs, reports."""
