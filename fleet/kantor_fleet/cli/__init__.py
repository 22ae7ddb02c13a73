"""The command line: one file for each verb, with its options and their checks.

A verb checks its options, calls the room that does the work, and returns an exit code (`exits.py`). Start with
`__main__.py` one level up, which lists the verbs.
"""
