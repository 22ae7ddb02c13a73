"""Imported by the fork server only, first: it ends with the command that started it, and with nothing else.

The signals that end a group of processes are for the command, which ends its processes in order. The command's own end
is also seen by a pipe that `multiprocessing` has, so that none is missed that comes before this.
"""

import signal

from kantor_fleet.execution.parent_death import die_with_parent

die_with_parent()
for _number in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(_number, signal.SIG_IGN)
