"""The files that a scenario is read from, each with the digest of its content.

This is the one list of them: a sweep knows runs by it, the manifest of a run keeps it, and `kantor verify` compares it
with the files of today. Faults from a file of their own are part of the scenario itself, and are not listed.
"""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import msgspec

from kantor_protocol.files.reading import digest_of
from kantor_protocol.scenario.file_names import name_of, path_of
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.nav2 import image_named_in

IMAGE_OF_MAP = "map.file: image"
"""The image that a map's YAML file names."""


class InputFile(msgspec.Struct, frozen=True):
    """A file that decides a run."""

    key: str
    """The key of the scenario that names it."""
    name: str
    """Absolute, as in the scenario."""
    blake2b: str | None
    """Of its content; None if it cannot be read."""

    @property
    def path(self) -> Path:
        """Where it is."""
        return path_of(self.name)


Digest = Callable[[Path], str | None]


def inputs_of(scenario: Scenario, digest: Digest = digest_of) -> tuple[InputFile, ...]:
    """The files that a scenario is read from. digest: of the content of a file, None if it cannot be read."""
    return tuple(InputFile(key, name, digest(path_of(name))) for key, name in _named_by(scenario))


def _named_by(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Each key with the file that it names."""
    if scenario.map is not None and scenario.map.file is not None:
        yield "map.file", scenario.map.file
        path = path_of(scenario.map.file)
        if path.suffix.lower() in {".yaml", ".yml"} and (image := image_named_in(path)) is not None:
            yield IMAGE_OF_MAP, name_of(image)
    for key, name in (
        ("samples.file", scenario.samples.file),
        ("targets.file", scenario.targets.file),
    ):
        if name is not None:
            yield key, name


def changes_since(inputs: Iterable[InputFile], digest: Digest = digest_of) -> Iterator[str]:
    """A phrase for each file whose content is another one now."""
    for file in inputs:
        now = digest(file.path)
        if now != file.blake2b:
            yield f"{file.key} {file.path} {'has changed' if now else 'is gone'}"
