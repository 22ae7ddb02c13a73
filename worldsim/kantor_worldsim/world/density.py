"""Samples, targets and starts: drawn once, by world-sim, from the scenario and the seed.

Samples are sorted along a Morton curve, so that neighbours in space are neighbours in memory and in
what is sent.
"""

from pathlib import Path
from tokenize import TokenError

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.counter_rng import Purpose, generator
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.schema import Domain, Gaussian, Scenario
from kantor_protocol.scenario.validate import is_image
from kantor_worldsim.world.maps import UNREADABLE

Points = npt.NDArray[np.float64]


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
        return _around(_points("samples", scenario.samples.file), targets.count, seed)
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
    points = _points(key, file)
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
    from PIL import Image  # noqa: PLC0415  only where an image is used

    try:
        with Image.open(file) as image:
            grey = np.asarray(image.convert("F"), dtype=np.float64)
    except FileNotFoundError:
        raise ScenarioError(f"{key}.file: {file}: no such file") from None
    except (*UNREADABLE, Image.DecompressionBombError) as error:
        raise ScenarioError(f"{key}.file: {file}: not a readable image: {error}") from None
    if not np.isfinite(grey).all() or grey.min() < 0.0 or grey.sum() <= 0.0:
        raise ScenarioError(f"{key}.file: {file}: no bright pixel; white is dense, black is empty")
    shares = (grey / grey.sum()).ravel()
    pixel = random.choice(shares.shape[0], count, p=shares)
    row, column = np.divmod(pixel, grey.shape[1])
    place = np.column_stack((column, grey.shape[0] - 1 - row)) + random.random((count, 2))
    low, high = np.array(domain.min_m), np.array(domain.max_m)
    return np.asarray(low + place / np.array(grey.shape[::-1]) * (high - low))


def _points(key: str, file: str) -> Points:
    """Rows of x, y in metres from CSV (a header is allowed) or NPY."""
    path = Path(file)
    try:
        points = _csv(path) if path.suffix.lower() == ".csv" else _npy(path)
    except FileNotFoundError:
        raise ScenarioError(f"{key}.file: {file}: no such file") from None
    except (*UNREADABLE, TokenError) as error:
        problem = str(error).splitlines()[0]
        raise ScenarioError(f"{key}.file: {file}: not a table of x, y: {problem}") from None
    if points.ndim != 2 or points.shape[1] != 2 or points.dtype.kind not in "fiu":
        raise ScenarioError(
            f"{key}.file: {file}: shape {points.shape}; give two columns, x and y in metres"
        )
    if points.shape[0] == 0:
        raise ScenarioError(f"{key}.file: {file}: no points in it; give at least one")
    points = points.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise ScenarioError(f"{key}.file: {file}: row {bad[0] + 1} is not finite; remove it")
    return points


def _csv(path: Path) -> Points:
    text = (line.partition("#")[0] for line in path.read_text(encoding="utf-8-sig").splitlines())
    lines = [line for line in text if line.strip()]
    rows = lines if lines and _is_row(lines[0]) else lines[1:]
    return np.loadtxt(rows, delimiter=",", ndmin=2) if rows else np.zeros((0, 2))


def _npy(path: Path) -> Points:
    with path.open("rb") as file:  # np.load would also open archives
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def _is_row(line: str) -> bool:
    """Whether a line of CSV holds numbers; a header does not."""
    try:
        _ = [float(cell) for cell in line.split(",")]
    except ValueError:
        return False
    return True


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
