"""Checkers: rules that every record must satisfy, each with a test that breaks it.

One file for each subject; `checker.py` runs them batch by batch, with links, walls and outages by their own reading
of the scenario (`links.py`, `sight.py`, `outages.py`). They share no code with the radio, the world and
the engine, whose mistakes they must find. Start with `checker.py`.
"""
