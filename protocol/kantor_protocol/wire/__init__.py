"""The wire format: every message, key and version vector, encoded and checked.

All bytes from the bus pass through a decoder of this room before anything else reads them. What a message means to
its receiver is decided in `replication` and in the participants. Start with `messages.py`.
"""
