"""When robots on a map get new targets, and which participant assigns them.

The same rules run in the supervisor and in a robot without one. How targets are distributed is a planner's
choice. Start with `assignment.py`.
"""
