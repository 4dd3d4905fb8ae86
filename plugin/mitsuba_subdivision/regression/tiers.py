"""The tiers of a comparison: their tolerances, results and tests.

The tests compare geometry probes, pixels of the same samples, means of tiles relative to noise, and perception.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import RegressionError
from .image import Estimate, Image, without_sample_counts

TIERS = {
    "probe": "what the rays through the centres of the pixels hit",
    "paired": "pixels from the same samples, which must be the same",
    "tile": "tiles of several sizes: does noise explain their difference?",
    "flip": "converged images, by perception",
}
# Noise increases FLIP's errors, so this tier is only for images that no other tier can compare.
DEFAULT_TIERS = ("probe", "paired", "tile")

DARK = 1e-3  # Differences are relative to at least this part of the image's mean
# Both images have the same samples if these agree. References of older versions lack the last two.
_SAME_SAMPLES, _IF_KNOWN = ("variant", "filter", "paired"), ("sampler", "sensor")

# Sides of the square tiles in pixels; None for the whole image. Small tiles find dents, large ones changes of colour.
SCALES: tuple[int | None, ...] = (4, 8, 16, None)
REFERENCE_SAMPLES = 16  # Recommended samples of a reference per sample of the test, for negligible noise
NOISE_TILE = 4  # Side of the tiles for the ratio of the test's noise to the reference's
SPECTRA = 5e-4  # Error of Mitsuba's spectra of a colour, relative to its largest value; measured for 18 colours
# Least part of the variance for images with all samples in common. If a single bright path makes all noise of a pixel,
# and rounding changes this path, the difference is 1 / sqrt(0.1) = 3.2 standard errors.
LEAST_NOISE = 0.1
_MOST_FREEDOM = 1e12  # More degrees of freedom make no difference

# Value that FLIP's tone curve, ACES, maps to 0.85, which limits its exposures; and weights of R, G and B.
_BRIGHT = 2.118872324
_LUMINANCE = (0.2126, 0.7152, 0.0722)
_MOST_STOPS = 12  # Most stops between the brightest and the median pixel: more take time and show nothing new


class Status(Enum):
    """Outcome of a tier, or of a whole comparison; the last one of several counts."""

    SKIPPED = "skipped"  # The images lack the tier's channels
    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"


@dataclass(eq=False)
class TierResult:
    """The result of one tier."""

    name: str
    status: Status
    lines: list[str]  # Findings, the most important first
    numbers: dict[str, Any] = field(default_factory=dict)  # Findings as plain numbers, strings and lists
    worst: tuple[int, int] | None = None  # Row and column of the pixel that shows the difference best
    maps: dict[str, NDArray[np.floating]] = field(default_factory=dict)  # (height, width) each, for the report


@dataclass(frozen=True)
class Tolerances:
    """Limits of the tiers for differences of two images, stored with the reference.

    Limits of the probe are at least four times the differences between variants of Mitsuba (scalar and LLVM: 6e-5
    degrees, 1.2e-6 diagonals, 1.3e-5 in the parameters of a triangle), and small enough to notice an error of a
    thousandth in one weight of a refinement rule (0.009 degrees, 1.2e-5 diagonals).
    """

    mask_fraction: float = 1e-3  # Share of pixels that may show another shape or element, or a hit in one image only
    angle_p999: float = 0.002  # Degrees between shading normals away from silhouettes, 99.9th percentile
    angle_max: float = 0.01  # Their maximum
    position: float = 5e-6  # Distance of hit points, in diagonals of the bounding box of all hit points
    uv_p999: float = 1e-3  # Difference of parameters where the same triangle is hit, 99.9th percentile
    paired_relative: float = 1e-5  # Relative difference of pixels with the same samples; 0 demands equal bits
    alpha: float = 0.01  # Probability that any scene of a suite without changes fails the tile tier
    # Addition to the standard error of a tile for sums in single precision: relative to its mean, and in radiance
    floor_relative: float = 2e-4
    floor_absolute: float = 1e-6
    flip_mean: float = 0.005  # Mean of FLIP
    flip_p95: float = 0.02  # 95th percentile of FLIP

    def with_values(self, values: Mapping[str, Any]) -> Tolerances:
        """Replace some limits. Raises RegressionError for an unknown name, or a negative or non-finite value."""
        known = [field.name for field in fields(self)]
        for name, value in values.items():
            if name not in known:
                raise RegressionError(f'unknown tolerance "{name}"; expected one of {", ".join(known)}')
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < math.inf:
                raise RegressionError(f'tolerance "{name}" is {value!r}; expected a number of at least 0')
        if not 0 < values.get("alpha", self.alpha) < 1:
            raise RegressionError(f'tolerance "alpha" is {values["alpha"]}; expected a probability between 0 and 1')
        return replace(self, **{name: float(value) for name, value in values.items()})

    as_dict = asdict


def pixel_of_largest(values: NDArray[np.floating]) -> tuple[int, int]:
    """Row and column of the largest value of a map ``(height, width)``."""
    return divmod(int(np.argmax(values)), values.shape[1])


def _skipped_without(name: str, reference: object | None, test: object | None, what: str) -> TierResult:
    lacking = "images have" if reference is test is None else "reference has" if reference is None else "test has"
    return TierResult(name, Status.SKIPPED, [f"the {lacking} no {what}"])


def compare_probes(reference_image: Image, test_image: Image, tolerances: Tolerances) -> TierResult:
    """Compare the geometry probes of two images.

    Normals, points and parameters are compared away from silhouettes, where rounding decides what a ray hits: where a
    pixel or one of its eight neighbours hits another shape than its neighbours or than the other probe. Other triangles
    of the same surface are only a warning, as the numbering of a mesh may change.
    """
    from scipy.ndimage import binary_dilation, generate_binary_structure, morphological_gradient

    reference, test = reference_image.probe, test_image.probe
    if reference is None or test is None:
        return _skipped_without("probe", reference, test, "geometry probe (channels P, Ns, uv, prim)")
    pixels = reference.shape.size
    both = reference.hit & test.hit
    other_shape = reference.shape != test.shape
    shapes = np.stack([reference.shape, test.shape])
    # Pixels beside, above or below a pixel with another shape; then also their eight neighbours.
    cross = generate_binary_structure(2, 1)[None]
    edges = (morphological_gradient(shapes, footprint=cross, mode="nearest") > 0).any(axis=0) | other_shape
    inside = both & ~binary_dilation(edges, generate_binary_structure(2, 2))
    same_triangle = inside & (reference.triangle == test.triangle)
    other_element = inside & (reference.element != test.element)

    angle = np.where(both, normal_angle(reference.normal, test.normal), 0)
    points = reference.position[reference.hit].astype(np.float64)
    diagonal = (float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0) or 1.0
    distance = np.linalg.norm(reference.position.astype(float) - test.position, axis=-1) / diagonal
    parameters = np.abs(reference.uv.astype(float) - test.uv).max(axis=-1)
    other_triangle = float((inside & ~same_triangle).sum() / pixels)

    # Each measurement, what it is, its value, and that at each pixel.
    turned, apart = np.where(inside, angle, 0), np.where(inside, distance, 0)
    shifted = np.where(same_triangle, parameters, 0)
    criteria = {
        "mask_fraction": ("of the pixels hit another shape", other_shape.sum() / pixels, other_shape),
        "element_fraction": ("of the pixels hit another element", other_element.sum() / pixels, other_element),
        "angle_p999": ("degrees between normals, 99.9th percentile", _percentile(angle[inside]), turned),
        "angle_max": ("degrees between normals, maximum", turned.max(), turned),
        "position": (f"of the diagonal {diagonal:.4g} between hit points", apart.max(), apart),
        "uv_p999": ("between surface parameters, 99.9th percentile", _percentile(parameters[same_triangle]), shifted),
    }
    numbers = {name: float(value) for name, (_, value, _) in criteria.items()} | {"triangle_fraction": other_triangle}
    limits = {"element_fraction": tolerances.mask_fraction, **tolerances.as_dict()}
    broken = [name for name in criteria if not numbers[name] <= limits[name]]
    worst, status = None, Status.PASS
    lines = [
        f"same shapes and elements, normals within {numbers['angle_max']:.2g} degrees, "
        f"points within {numbers['position']:.2g} of the diagonal"
    ]
    if broken:
        status, worst = Status.FAIL, pixel_of_largest(np.nan_to_num(criteria[broken[0]][2], nan=np.inf))
        lines = [f"{numbers[name]:.3g} {criteria[name][0]}; at most {limits[name]:.3g} expected" for name in broken]
    elif other_triangle > tolerances.mask_fraction:
        status = Status.WARN
        lines = [f"{other_triangle:.3g} of the pixels hit another triangle of the same element"]
    return TierResult("probe", status, lines, numbers, worst, {"angle": np.where(inside, angle, np.nan)})


def normal_angle(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """Angle in degrees between unit vectors, accurate for tiny angles. Not a number if one of them is zero."""
    with np.errstate(invalid="ignore", divide="ignore"):
        a, b = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (a.astype(np.float64), b.astype(np.float64)))
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def _percentile(values: NDArray[np.floating]) -> float:
    return float(np.percentile(values, 99.9)) if values.size else 0.0


def compare_paired(reference: Image, test: Image, tolerances: Tolerances) -> TierResult:
    """Compare the first batches of two images, which have the same samples.

    Skipped, with the reason, if the samples are not the same. On another machine or with other versions of libraries,
    equal pixels still prove that nothing changed, but different ones prove nothing: the tier then warns.
    """
    if reference.paired is None or test.paired is None:
        what = "first batch to pair (channels paired.R, paired.G, paired.B)"
        return _skipped_without("paired", reference.paired, test.paired, what)
    if reason := _different_samples(reference, test):
        return TierResult("paired", Status.SKIPPED, [reason])
    difference = test.paired - reference.paired
    size = np.maximum(np.abs(reference.paired), DARK * levels(reference.paired))
    relative = np.abs(difference) / np.where(size > 0, size, 1)
    largest = float(relative.max())
    changed = int(difference.any(axis=2).sum())
    numbers = {"paired_relative": largest, "changed_pixels": changed, "pixels": int(difference[..., 0].size)}
    maps = {"paired": relative_difference(reference.paired, test.paired)}
    if largest <= tolerances.paired_relative:
        line = "the same bits" if changed == 0 else f"relative difference up to {largest:.2g}, in {changed} pixels"
        return TierResult("paired", Status.PASS, [line], numbers, maps=maps)
    line = (
        f"same samples, but {changed} of {numbers['pixels']} pixels differ, by up to {largest:.3g} relative; "
        f"at most {tolerances.paired_relative:.2g} expected"
    )
    result = TierResult("paired", Status.FAIL, [line], numbers, pixel_of_largest(relative.max(axis=2)), maps)
    doubts = _differences(reference.metadata.get("environment", {}), test.metadata.get("environment", {}))
    if reference.metadata.get("files") != test.metadata.get("files") and "sampler" not in reference.metadata:
        doubts.append("the reference, of an older version, does not say with which sampler")
    if doubts:
        result.status = Status.WARN
        result.lines.append(f"which may come from the environment: {'; '.join(doubts)}")
    return result


def _noise_left(reference: Image, test: Image, estimate: Estimate) -> float:
    """Share of both images' variance in their difference: 1, or less if they have all samples in common.

    Rounding then changes a few paths; the first batches show how many.
    """
    records = [image.metadata.get("sampling", {}) for image in (reference, test)]
    a, b = ([record.get(key) for key in ("seed", "batch", "batches")] for record in records)
    if None in a or a != b or reference.paired is None or test.paired is None or _different_samples(reference, test):
        return 1.0
    squares = (test.paired - reference.paired) ** 2
    total = 2 * estimate.variance / test.metadata["paired"]["spp"]
    return min(1.0, max(LEAST_NOISE, float(squares.sum() / max(total.sum(), 1e-30))))


def levels(pixels: NDArray[np.floating]) -> NDArray[np.floating]:
    """Mean absolute values of the channels ``(channels,)``; R, G and B share one."""
    result = np.abs(pixels).mean(axis=(0, 1))
    result[:3] = result[:3].mean()
    return result


def relative_difference(reference: NDArray[np.floating], test: NDArray[np.floating]) -> NDArray[np.floating]:
    """Map of the relative difference between two images, as the mean over R, G and B; reduced in dark pixels."""
    reference, test = reference[..., :3], test[..., :3]
    grey = 0.01 * np.abs(reference).mean() + 1e-12
    return (test.mean(axis=2) - reference.mean(axis=2)) / (np.abs(reference).mean(axis=2) + grey)


def _different_samples(reference: Image, test: Image) -> str | None:
    for role, image in (("reference", reference), ("test", test)):
        if "paired" not in image.metadata:
            return f"the {role} does not say with which seed its first batch was rendered"
    keys = [*_SAME_SAMPLES, *(key for key in _IF_KNOWN if key in reference.metadata and key in test.metadata)]
    wanted, given = ({key: image.metadata.get(key) for key in keys} for image in (reference, test))
    for described in (wanted, given):
        if sampler := described.get("sampler"):  # Older references also contain the sampler's numbers of samples
            described["sampler"] = without_sample_counts(sampler)
    if different := _differences(wanted, given):
        return f"the samples are not the same: {'; '.join(different)}"
    if wanted["filter"] != "box":
        return f'filter "{wanted["filter"]}" adds samples in any order; expected "box"'
    return None


def _differences(reference: dict[str, Any], test: dict[str, Any]) -> list[str]:
    return [
        f"{key} {_in_words(test.get(key))} here, {_in_words(reference.get(key))} in the reference"
        for key in sorted({*reference, *test})
        if reference.get(key) != test.get(key)
    ]


def _in_words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {entry}" for key, entry in value.items())
    return "unknown" if value is None else str(value)


def compare_tiles(reference: Image, test: Image, tolerances: Tolerances) -> TierResult:
    """Test whether noise alone explains the difference of each tile: two-sided tests, at several scales.

    The batches of each image give its noise. A test of few samples may miss a tile's rare bright paths and show no
    noise, so its noise is at least the reference's prediction for as many samples. For images with the same samples,
    only rounding leaves noise. `_z_scores` has the formulas.

    The standard error has a floor, for the bias of single precision and of spectra of colours. Šidák's correction
    covers the tiles and channels of a scale, Bonferroni's the scales.
    """
    expected, tested = reference.estimate, test.estimate
    if expected is None or tested is None:
        return _skipped_without("tile", expected, tested, "channels variance.R, .G, .B and N")
    for estimate, role in ((expected, "reference"), (tested, "test")):
        if estimate.batches < 2:
            return TierResult("tile", Status.SKIPPED, [f"the {role} has one batch only, which gives no variance"])
    from scipy.special import log_ndtr, ndtr  # `scipy.stats` is slow to import

    left = _noise_left(reference, test, expected)
    expected, tested = (replace(estimate, variance=left * estimate.variance) for estimate in (expected, tested))
    sides = SCALES if left == 1 else (1, *SCALES)
    height, width, _ = expected.mean.shape
    scales, failing, evidence = {}, [], {}
    floor = tolerances.floor_relative * np.abs(expected.mean) + tolerances.floor_absolute
    are_spectral = {"spectral" in image.metadata.get("variant", "") for image in (reference, test)}
    if len(are_spectral) > 1:
        floor[..., :3] += SPECTRA * np.abs(reference.rgb).max(axis=2, keepdims=True)
    # If a test is noisier in most tiles, it is also in tiles without rare paths.
    own, others = (_tile_sums(estimate.variance, NOISE_TILE) for estimate in (tested, expected))
    noisier = np.median(own[others > 0] / others[others > 0]) if others.any() else 1
    least = max(1.0, float(noisier)) * expected.variance
    for scale in sides:
        side = scale or max(height, width)
        z = _z_scores(expected, tested, least, floor, side)
        p = 2 * ndtr(-np.abs(z))
        limit = float(-np.expm1(np.log1p(-tolerances.alpha / len(sides)) / z.size))
        places = np.argwhere(p < limit)
        scales[str(scale or "whole")] = {
            "smallest_p": float(p.min()),
            "limit": limit,
            "largest_z": float(np.abs(z).max()),
            "failing": len(places),
            "tests": int(z.size),
        }
        for row, column, channel in places:
            x, y = side * int(column), side * int(row)
            place = {"x": x, "y": y, "width": min(side, width - x), "height": min(side, height - y)}
            failing.append({**place, "channel": reference.names[channel], "z": float(z[row, column, channel])})
        if scale:
            smallest = (log_ndtr(-np.abs(z)).min(axis=2) + np.log(2)) / -np.log(10)
            evidence[p.min() / limit] = np.repeat(np.repeat(smallest, side, axis=0), side, axis=1)[:height, :width]

    pixel_z = _z_scores(expected, tested, least, floor, 1)
    strongest = np.take_along_axis(pixel_z, np.abs(pixel_z).argmax(axis=2, keepdims=True), axis=2)[..., 0]
    spp, reference_spp = (int(np.median(estimate.count)) for estimate in (tested, expected))
    samples = f"{spp} samples per pixel against {reference_spp}{'' if left == 1 else ', the same ones'}"
    result = TierResult(
        "tile",
        Status.FAIL if failing else Status.PASS,
        [f"noise explains every tile ({samples})"],
        {"scales": scales, "samples": spp, "failing": failing},
        # The scale with the smallest probability relative to its limit shows the difference best.
        maps={"z": strongest, "evidence": evidence[min(evidence)]},
    )
    if failing:
        sizes = {name: "full size" if name == "whole" else f"{name} x {name}" for name in scales}
        counts = [f"{s['failing']} of {s['tests']} at {sizes[name]}" for name, s in scales.items() if s["failing"]]
        clearest = max(failing, key=lambda tile: abs(tile["z"]))
        where = "clearest: {width} x {height} pixels at x = {x}, y = {y}, channel {channel}, z = {z:+.1f}"
        result.lines = [f"not noise ({samples}); tests that fail: {', '.join(counts)}", where.format(**clearest)]
        if len(are_spectral) > 1:
            result.lines.append("one variant is spectral: light between coloured surfaces differs from that of RGB")
        # The worst pixel lies in the smallest failed tile.
        small = min(failing, key=lambda tile: (tile["width"] * tile["height"], -abs(tile["z"])))
        x, y = small["x"], small["y"]
        row, column = pixel_of_largest(np.abs(strongest[y : y + small["height"], x : x + small["width"]]))
        result.worst = (y + row, x + column)
    if left == 1 and reference_spp < REFERENCE_SAMPLES * spp:
        few = f"less than {REFERENCE_SAMPLES} times the samples: its own noise hides small changes"
        result.lines.append(f"the reference has {few}")
    return result


def _z_scores(
    reference: Estimate, test: Estimate, least: NDArray[np.floating], floor: NDArray[np.floating], side: int
) -> NDArray[np.float64]:
    """z-scores ``(rows, columns, channels)`` of the tiles of one size.

    Let D be the difference of a tile's means and s^2 its variance, the sum of both images'. Each is a sum over batches
    of its pixels, so that D / s has Student's distribution, with the degrees of freedom of [Welch 1947]. It is
    converted to a normal variable by [Wallace 1959]. Variances of the test and errors of pixels have least values.
    """
    area = _tile_sums(np.ones((*test.count.shape, 1)), side)
    difference, bias = (_tile_sums(values, side) / area for values in (test.mean - reference.mean, floor))

    def measured(variance: NDArray[np.floating], count: NDArray[np.integer], batches: int) -> NDArray[np.float64]:
        """Variances of the means of tiles; and their squares over the degrees of freedom."""
        of_mean = variance / count[..., None]
        # The expected square of an estimated variance of n degrees of freedom is 1 + 2 / n times too large.
        return np.stack([_tile_sums(of_mean, side) / area**2, _tile_sums(of_mean**2, side) / area**4 / (batches + 1)])

    own, expected = measured(test.variance, test.count, test.batches), measured(least, test.count, reference.batches)
    of_test = np.where(own[0] > expected[0], own, expected)
    variance, scatter = measured(reference.variance, reference.count, reference.batches) + of_test
    variance += bias**2
    freedom = variance**2 / np.maximum(scatter, variance**2 / _MOST_FREEDOM)
    z = np.sqrt(freedom * np.log1p(difference**2 / variance / freedom)) * (8 * freedom + 1) / (8 * freedom + 3)
    return np.copysign(z, difference)


def _tile_sums(values: NDArray[np.floating], side: int) -> NDArray[np.float64]:
    rows, columns = (np.arange(0, length, side) for length in values.shape[:2])
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)


def flip_exposures(pixels: NDArray[np.floating]) -> tuple[float, float, int]:
    """First and last exposure for FLIP in stops, and their number, from a reference.

    FLIP itself ends the process at a black image. As in FLIP, the first and the last exposure map the brightest and the
    median luminance to 0.85 of the tone curve.
    """
    luminance = np.maximum(pixels, 0) @ _LUMINANCE
    brightest = float(luminance.max())
    if not brightest > 0:
        return 0.0, 1.0, 2
    median = max(float(np.median(luminance)), brightest * 2.0**-_MOST_STOPS)
    start, stop = float(np.log2(_BRIGHT / brightest)), float(np.log2(_BRIGHT / median))
    stop = max(stop, start + 1)
    return round(start, 3), round(stop, 3), max(2, int(np.ceil(stop - start)))


def compare_flip(reference: Image, test: Image, tolerances: Tolerances) -> TierResult:
    """Compare two converged images by perception, as if alternating between them.

    Raises RegressionError if FLIP is not installed, or if pixels are not finite, which FLIP scores well.
    """
    try:
        import flip_evaluator
    except ImportError:
        raise RegressionError("FLIP is not installed: pip install 'mitsuba-subdivision[figures]'") from None
    if not (np.isfinite(reference.pixels).all() and np.isfinite(test.pixels).all()):
        raise RegressionError("FLIP does not see pixels that are not finite; expected finite images")
    start, stop, count = flip_exposures(reference.rgb)
    # Arrays, as FLIP ends the process at unreadable files.
    both = [np.ascontiguousarray(image.rgb, dtype=np.float32) for image in (reference, test)]
    exposures = {"startExposure": start, "stopExposure": stop, "numExposures": count, "tonemapper": "ACES"}
    without = {"applyMagma": False, "computeMeanError": False}
    # Nonnegative, as its tone curve has poles; negative values by their size.
    signs = (1, -1) if min(pixels.min() for pixels in both) < 0 else (1,)
    pairs = [[np.maximum(sign * pixels, 0) for pixels in both] for sign in signs]
    of_rgb = [flip_evaluator.evaluate(*pair, "HDR", parameters=exposures, **without)[0] for pair in pairs]
    errors = {"R, G, B": np.max(of_rgb, axis=0)[..., 0].astype(np.float64), **_errors_of_others(reference, test)}
    seen = reference.seen_with(test)
    means = {name: float(values[seen].mean()) for name, values in errors.items()}
    p95s = {name: float(np.percentile(values[seen], 95)) for name, values in errors.items()}
    numbers = {"flip_mean": max(means.values()), "flip_p95": max(p95s.values()), "exposures": [start, stop, count]}
    failed = [name for name in errors if means[name] > tolerances.flip_mean or p95s[name] > tolerances.flip_p95]
    expected = f"at most {tolerances.flip_mean:.2g} and {tolerances.flip_p95:.2g} expected"
    lines = [
        f"{'' if len(errors) == 1 else f'{name}: '}mean {means[name]:.2g}, 95th percentile {p95s[name]:.2g}; {expected}"
        for name in failed or ["R, G, B"]
    ]
    worst = pixel_of_largest(errors[failed[0]] * seen) if failed else None
    status = Status.FAIL if failed else Status.PASS
    return TierResult("flip", status, lines, numbers, worst, {"flip": errors["R, G, B"]})


def _errors_of_others(reference: Image, test: Image) -> dict[str, NDArray[np.floating]]:
    """Differences that FLIP ignores: of alpha, and relative ones of layers and AOVs, by name."""
    errors: dict[str, NDArray[np.floating]] = {}
    for i, name in enumerate(reference.names[3:], start=3):
        a, b = np.abs(reference.pixels[..., i]), np.abs(test.pixels[..., i])
        least = DARK * np.median(a[a > 0]) if a.any() else 1.0
        size = 1.0 if name.rpartition(".")[2] == "A" else np.maximum(np.maximum(a, b), least)
        errors[name] = np.abs(test.pixels[..., i] - reference.pixels[..., i]) / size
    return errors


COMPARE = {"probe": compare_probes, "paired": compare_paired, "tile": compare_tiles, "flip": compare_flip}
