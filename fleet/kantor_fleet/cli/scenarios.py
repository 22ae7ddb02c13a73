"""`kantor scenarios`: its options and their checks."""

from typing import Annotated, Literal

import tyro

from kantor_fleet.exits import Exit


def scenarios(
    action: Annotated[Literal["list", "show"], tyro.conf.Positional] = "list",
    name: Annotated[str, tyro.conf.Positional] = "fleet",
    /,
) -> int:
    """List the packaged scenarios, or show one as TOML.

    Args:
        action: list or show.
        name: The scenario to show.
    """
    from kantor_fleet.scenarios.catalog import find, names, path_of  # noqa: PLC0415

    if action == "show":
        print(path_of(name).read_text(encoding="utf-8"), end="")
        return Exit.DONE
    width = max(map(len, names()))
    for known in names():
        print(f"{known:<{width}}  {find(known).summary}")
    return Exit.DONE
