"""Logs of processes: JSON lines, one file each."""

import os
from collections.abc import Callable
from pathlib import Path

import structlog


def log_to(path: Path, process: str) -> Callable[[str], None]:
    """Send everything that this process prints to a file, and return a line-by-line log into it."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.close(descriptor)
    logger = structlog.wrap_logger(
        structlog.WriteLogger(),
        processors=[
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.JSONRenderer(),
        ],
    ).bind(process=process, pid=os.getpid())

    def say(line: str) -> None:
        logger.msg(line)

    return say
