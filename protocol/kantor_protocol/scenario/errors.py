"""The error of a scenario that cannot be run."""


class ScenarioError(ValueError):
    """A scenario that cannot be run; the message is one line with the place and the remedy."""

    def __init__(self, message: str) -> None:
        line = " ".join(message.split())
        super().__init__(
            line.encode(errors="backslashreplace").decode()
        )  # names of files may be any bytes
