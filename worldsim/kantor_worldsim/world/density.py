"""Samples, targets and starts: drawn once, by world-sim, from the scenario and the seed.

Samples are sorted along a Morton curve, so that neighbours in space are neighbours in memory and in
what is sent.
"""

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.counter_rng import Purpose, generator
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.file_names import path_of
from kantor_protocol.scenario.schema import Domain, Gaussian, Scenario
from kantor_protocol.scenario.validate import is_image
from kantor_worldsim.world.pictures import decoded, opacity
from kantor_worldsim.world.points import Points, points_in

if TYPE_CHECKING:
    from PIL.Image import Image


def samples_of(scenario: Scenario, seed: int) -> Points:
    """(N, 2) samples, world frame, metres. Raises ScenarioError for an unusable file."""
    points = _drawn(
        "samples", scenario, scenario.samples.file, scenario.samples.count, seed, stratified=True
    )
    if points.shape[0] == 0:
        raise ScenarioError("samples.count: no samples at all; give at least one")
    return points[_morton_order(points)]


def targets_of(scenario: Scenario, seed: int) -> Points:
    """(T, 2) targets, world frame, metres; from the samples' source unless they have a file."""
    targets = scenario.targets
    if targets.file is not None:
        return _drawn(
            "targets", scenario, targets.file, targets.count or None, seed, stratified=False
        )
    if targets.count == 0:
        return np.zeros((0, 2))
    if scenario.samples.file is not None and not is_image(scenario.samples.file):
        return _around(points_in("samples", scenario.samples.file), targets.count, seed)
    return _drawn("targets", scenario, scenario.samples.file, targets.count, seed, stratified=False)


def starts_of(scenario: Scenario, seed: int) -> Points:
    """(n, 2) positions of the robots at time 0, world frame, metres."""
    if not scenario.starts.random:
        return np.array(scenario.starts.poses_m, dtype=np.float64)
    low, high = np.array(scenario.domain.min_m), np.array(scenario.domain.max_m)
    draws = generator(seed, Purpose.STARTS).random((scenario.robots.count, 2))
    return np.asarray(low + draws * (high - low))


def _drawn(
    key: str,
    scenario: Scenario,
    file: str | None,
    count: int | None,
    seed: int,
    *,
    stratified: bool,
) -> Points:
    purpose = Purpose.SAMPLES if key == "samples" else Purpose.TARGETS
    random = generator(seed, purpose)
    if file is None:
        return _from_mixture(scenario.density, count or 0, random, stratified=stratified)
    if is_image(file):
        if count is None:
            raise ScenarioError(f"{key}.count: missing; an image needs the number of points")
        return _from_image(key, file, scenario.domain, count, random)
    points = points_in(key, file)
    if count is None or count >= points.shape[0]:
        return points
    subset = generator(seed, Purpose.SUBSET).choice(points.shape[0], count, replace=False)
    return points[np.sort(subset)]


def _from_mixture(
    components: tuple[Gaussian, ...], count: int, random: np.random.Generator, *, stratified: bool
) -> Points:
    """Exact shares of each component when stratified (the paper's samples), else independent draws."""
    weights = np.array([component.weight for component in components])
    shares = weights / weights.sum()
    if stratified:
        sizes = np.floor(shares * count + 1e-9).astype(int)
        rest = np.argsort(sizes - shares * count, kind="stable")[: count - sizes.sum()]
        sizes[rest] += 1
        chosen = np.repeat(np.arange(len(components)), sizes)
    else:
        chosen = random.choice(len(components), count, p=shares)
    mean = np.array([component.mean_m for component in components])
    deviation = np.sqrt([component.variance_m2 for component in components])
    return np.asarray(mean[chosen] + deviation[chosen] * random.standard_normal((count, 2)))


def _from_image(
    key: str, file: str, domain: Domain, count: int, random: np.random.Generator
) -> Points:
    """Draws by the brightness of pixels, uniform within a pixel; the image spans the domain, top row up."""
    path = path_of(file)
    grey, _ = decoded(path, f"{key}.file:", _brightness)
    if not np.isfinite(grey).all() or grey.min() < 0.0 or grey.sum() <= 0.0:
        raise ScenarioError(
            f"{key}.file: {path}: no bright pixel; white is dense, black and transparent are empty"
        )
    shares = (grey / grey.sum()).ravel()
    pixel = random.choice(shares.shape[0], count, p=shares)
    row, column = np.divmod(pixel, grey.shape[1])
    place = np.column_stack((column, grey.shape[0] - 1 - row)) + random.random((count, 2))
    low, high = np.array(domain.min_m), np.array(domain.max_m)
    return np.asarray(low + place / np.array(grey.shape[::-1]) * (high - low))


def _brightness(image: "Image") -> npt.NDArray[np.float64]:
    """(rows, columns), top row first: brightness as far as a pixel is opaque."""
    grey = np.asarray(image.convert("F"), dtype=np.float64)
    alpha = opacity(image)
    return grey if alpha is None else grey * (alpha / 255.0)


def doubts_about_images(scenario: Scenario) -> list[str]:
    """Warnings about the files of images from which samples and targets are drawn. Raises ScenarioError."""
    named = (("samples", scenario.samples.file), ("targets", scenario.targets.file))
    return [
        line
        for key, name in named
        if name is not None and is_image(name)
        for line in decoded(path_of(name), f"{key}.file:", lambda _image: None)[1]
    ]


def _around(points: Points, count: int, seed: int) -> Points:
    """Draws from a kernel density estimate of the points (Scott's rule)."""
    from scipy.stats import gaussian_kde  # noqa: PLC0415  slow to import, rarely needed

    random = generator(seed, Purpose.TARGETS)
    try:
        density = gaussian_kde(points.T)
    except (np.linalg.LinAlgError, ValueError):  # too few, or all on one line
        return points[random.integers(points.shape[0], size=count)]
    return np.ascontiguousarray(density.resample(count, seed=random).T)


def _morton_order(points: Points) -> npt.NDArray[np.intp]:
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max()) or 1.0
    cells = ((points - low) / extent * 65535.0).astype(np.uint64)
    code = _spread(cells[:, 0]) | (_spread(cells[:, 1]) << np.uint64(1))
    return np.argsort(code, kind="stable")


def _spread(value: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """The low 16 bits with a zero after each."""
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        value = (value | (value << np.uint64(shift))) & np.uint64(mask)
    return value
