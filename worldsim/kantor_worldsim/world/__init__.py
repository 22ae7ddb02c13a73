"""The truth: maps, targets, sensors, and the verdicts on steps.

Files and generators that a mission starts from, and the rules of motion and energy. Messages and records are not
known here. Start with `world.py`.
"""
