"""How long a test waits for an event. It is a guard against hanging, never a statement about speed."""

EVENT_LIMIT_S = 600.0
"""Enough for kernels that are compiled first, on a slow machine with other work."""
