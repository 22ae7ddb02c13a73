"""Imported by the fork server only, last: its processes begin with the Ctrl-C of a terminal ignored."""

import signal

signal.signal(signal.SIGINT, signal.SIG_IGN)
