"""The error of a scenario that cannot be run."""


class ScenarioError(ValueError):
    """A scenario that cannot be run; the message is one line with the place and the remedy."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))
