"""Imported by the fork server only: warms it up, so that its children start warm."""

import signal

# Ctrl-C while kernels are compiled ends the fork server at once and without a traceback.
_handler = signal.signal(signal.SIGINT, signal.SIG_DFL)

from kantor_fleet.execution.preload import warm_up  # noqa: E402  importing takes a while, too

warm_up()
signal.signal(signal.SIGINT, _handler)
