"""Faults as tables and as drawn schedules, and a radio with faults that needs no mission."""
