"""Imported by the fork server only: warms it up, so that its children start warm.

For missions of all kinds, or of those that the environment names: a module that is preloaded takes no arguments.
"""

import os
import signal

# Ctrl-C while kernels are compiled ends the fork server at once and without a traceback.
_handler = signal.signal(signal.SIGINT, signal.SIG_DFL)

from kantor_fleet.execution.preload import KINDS, warm_up  # noqa: E402  importing takes a while, too

_only = os.environ.get("KANTOR_PRELOADED", ",".join(KINDS)).split(",")
warm_up([kind for kind in KINDS if kind in _only])
signal.signal(signal.SIGINT, _handler)
