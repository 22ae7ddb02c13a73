"""Logs of processes: a file of JSON lines each."""

import os
from collections.abc import Callable
from pathlib import Path

import structlog


def log_to(path: Path, process: str) -> Callable[[str], None]:
    """Redirect all output of this process to a file, and return a function that logs a line there."""
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

    def log(line: str) -> None:
        logger.msg(line)

    return log
