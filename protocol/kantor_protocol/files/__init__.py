"""Files of users, read under one guard: what they are, how large, how encoded, how deeply nested.

Every file that a person or another program wrote is opened here, and every refusal is one line with the path. What the
contents mean is decided where they are used. Start with `reading.py`.
"""
