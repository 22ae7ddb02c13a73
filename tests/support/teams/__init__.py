"""Floors drawn by hand, and the teams and markets that plan on them without a bus or a world."""
