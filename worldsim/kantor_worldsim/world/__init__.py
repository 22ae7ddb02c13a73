"""The truth: maps, targets, sensors, and what the world makes of a step.

Files and generators that a mission starts from, and the rules of motion and energy. Messages and records are not
known here. Start with `world.py`.
"""
