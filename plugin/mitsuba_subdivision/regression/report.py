"""The report of a comparison: one static HTML page, its numbers as JSON, and its maps as an OpenEXR file."""

from __future__ import annotations

import base64
import html
import io
import json
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..srgb import encoded
from ..whole_file import write_text
from . import RegressionError
from .compare import Comparison
from .image import write_channels
from .tiers import compare_flip, relative_difference

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE, NUMBERS, MAPS = "index.html", "comparison.json", "maps.exr"
MOST_OTHERS = 4  # Panels of channels besides R, G and B
COLUMNS, PANEL_INCHES, DOTS_PER_INCH = 4, 2.9, 160
ANGLES = (1e-5, 10.0)  # Degrees of the first and of the last colour
_SIGNED = "RdBu_r"
# Title, caption, colours, least range of the colours (so that rounding stays pale), and percentile at their end.
_MAPS = {
    "relative": ("Relative difference", "(test - reference) / reference,\nmean of R, G, B", _SIGNED, 0.01, 99.0),
    "paired": ("Paired difference", "from the same samples, so\nwithout noise", _SIGNED, 0.01, 99.0),
    "z": ("z-score", "over the standard error, strongest\nchannel; failing tiles outlined", _SIGNED, 5.0, 99.9),
    "evidence": ("Evidence against noise", "$-\\log_{10} p$ at the most\ntelling tiles", "viridis", 10.0, 100.0),
    "flip": ("FLIP", "HDR-FLIP error", "magma", 0.05, 100.0),
    "angle": ("Angle between normals", "degrees; grey at silhouettes\nand where nothing is hit", "magma", 0.0, 100.0),
}


def write_report(folder: str | Path, comparison: Comparison, title: str | None = None) -> Path:
    """Write the report of a comparison, and return the path of its self-contained page.

    The default title is the reference's name. Raises RegressionError if matplotlib is not installed.
    """
    folder = Path(folder)
    title = title or comparison.reference.name
    picture = _panels(comparison)
    folder.mkdir(parents=True, exist_ok=True)
    if comparison.maps:
        write_channels(folder / MAPS, comparison.maps)
    write_text(folder / NUMBERS, json.dumps({"title": title, **comparison.as_dict()}, indent=1) + "\n")
    write_text(folder / PAGE, _page(title, comparison, picture))
    return folder / PAGE


def write_index(folder: str | Path) -> Path | None:
    """Write a page that links to the reports in a folder, the failed ones first; none if there are no reports."""
    folder = Path(folder)
    rows = []
    for path in sorted(folder.glob(f"*/{NUMBERS}")):
        report = json.loads(path.read_text(encoding="utf-8"))
        tiers = ", ".join(f"{name} {tier['status']}" for name, tier in report["tiers"].items())
        link = f'<a href="{html.escape(path.parent.name)}/{PAGE}">{html.escape(report["title"])}</a>'
        rows.append((report["status"], f"<tr><td>{_badge(report['status'])}<td>{link}<td>{html.escape(tiers)}"))
    if not rows:
        (folder / PAGE).unlink(missing_ok=True)
        return None
    lines = "".join(line for _, line in sorted(rows, key=lambda row: ["fail", "warn", "pass"].index(row[0])))
    body = f"<h1>Render-difference tests</h1><table class=tiers>{lines}</table>"
    write_text(folder / PAGE, _document("Render-difference tests", body))
    return folder / PAGE


def srgb(pixels: NDArray[np.floating]) -> NDArray[np.floating]:
    """Linear RGB as sRGB codes from 0 to 1; non-finite pixels are magenta."""
    finite = np.isfinite(pixels).all(axis=-1, keepdims=True)
    return np.where(finite, encoded(np.clip(np.nan_to_num(pixels, posinf=0, neginf=0), 0, 1)), (1.0, 0.0, 1.0))


def _panels(comparison: Comparison) -> bytes:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise RegressionError("reports need matplotlib: pip install 'mitsuba-subdivision[figures]'") from None
    a, b = comparison.reference.rgb, comparison.test.rgb
    finite = bool(np.isfinite(comparison.reference.pixels).all() and np.isfinite(comparison.test.pixels).all())
    maps = {"relative": relative_difference(a, b), **_maps(comparison)} if finite else {}
    count = 2 + len(maps)
    rows, columns = -(-count // COLUMNS), min(COLUMNS, count)
    height = PANEL_INCHES * (a.shape[0] / a.shape[1] + 0.33)
    figure = Figure((columns * PANEL_INCHES, rows * height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, subplot_kw={"anchor": "N"}).ravel()
    for panel in axes[count:]:
        panel.set_axis_off()
    peak = np.percentile(a[np.isfinite(a)], 99.5) if np.isfinite(a).any() else 1.0
    scale = 1 / peak if peak > 0 else 1.0
    caption = f"sRGB at {np.log2(scale):+.1f} stops" + ("" if finite else ",\nnot finite in magenta")
    for panel, title, pixels in ((axes[0], "Reference", a), (axes[1], "Test", b)):
        panel.imshow(srgb(pixels * scale), interpolation="nearest")
        _finish(panel, comparison, title, caption)
    for panel, (name, values) in zip(axes[2:], maps.items(), strict=False):
        _draw_map(panel, comparison, name, values)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
    return file.getvalue()


def _maps(comparison: Comparison) -> dict[str, NDArray[np.floating]]:
    maps = comparison.maps
    if "flip" not in maps:
        with suppress(RegressionError):
            maps |= compare_flip(comparison.reference, comparison.test, comparison.tolerances).maps
    reference, test = comparison.reference, comparison.test
    others = {name: test.pixels[..., i] - reference.pixels[..., i] for i, name in enumerate(reference.names) if i > 2}
    # Alpha, and the most different channels.
    order = sorted(others, key=lambda name: (name != "A", -np.abs(others[name]).mean()))
    return maps | {f"difference of {name}": others[name] for name in order[:MOST_OTHERS]}


def _draw_map(panel: Axes, comparison: Comparison, name: str, values: NDArray[np.floating]) -> None:
    import matplotlib
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.patches import Rectangle
    from matplotlib.ticker import MaxNLocator

    # Alpha, layers and AOVs have their own units.
    other = (name[:1].upper() + name[1:], "test - reference", _SIGNED, 1e-6, 99.9)
    title, caption, colours, least, percentile = _MAPS.get(name, other)
    if name == "angle":
        norm: Normalize = LogNorm(*ANGLES)
        values = np.maximum(values, ANGLES[0])
    else:
        reach = max(least, float(np.percentile(np.abs(values), percentile)))
        norm = Normalize(-reach if colours == _SIGNED else 0, reach)
    colour_map = matplotlib.colormaps[colours].with_extremes(bad="0.55")
    picture = panel.imshow(np.ma.masked_invalid(values), colour_map, norm, interpolation="nearest")
    place: dict[str, Any] = {"location": "bottom", "shrink": 0.9, "aspect": 30, "pad": 0.02, "panchor": (0.5, 1.0)}
    ticks = None if name == "angle" else MaxNLocator(5)
    panel.figure.colorbar(picture, ax=panel, ticks=ticks, **place).ax.tick_params(labelsize=7.5)
    tile = comparison.tier("tile")
    for place in tile.numbers["failing"] if tile and name in ("z", "evidence") else ():
        box = (place["x"] - 0.5, place["y"] - 0.5), place["width"], place["height"]
        for colour, line in (("white", 2.0), ("black", 0.8)):
            panel.add_patch(Rectangle(*box, fill=False, edgecolor=colour, linewidth=line))
    if name == "flip" and not comparison.tier("flip"):
        caption += "; high where there is noise,\ndoes not count here"
    _finish(panel, comparison, title, caption)


def _finish(panel: Axes, comparison: Comparison, title: str, caption: str) -> None:
    from matplotlib.patches import Ellipse

    panel.set_title(title, fontsize=10, fontweight="bold", loc="left")
    panel.set_xlabel(caption, fontsize=7.5, color="0.35")
    panel.set(xticks=[], yticks=[])
    if comparison.worst:
        size = max(comparison.reference.size) / 14
        at = comparison.worst.x, comparison.worst.y
        panel.add_patch(Ellipse(at, size, size, fill=False, edgecolor="#ff2d9b", linestyle="--"))


def _page(title: str, comparison: Comparison, picture: bytes) -> str:
    rows = "".join(
        f"<tr><th>{tier.name}<td>{_badge(tier.status.value)}<td>{'<br>'.join(map(html.escape, tier.lines))}"
        for tier in comparison.tiers
    )
    remarks = "".join(f"<li>{html.escape(line)}" for line in comparison.remarks())
    marker = "Dashed circle: worst pixel. " if comparison.worst else ""
    width, height = comparison.reference.size
    made = [
        (role, key, value if isinstance(value := image.metadata[key], str) else json.dumps(value))
        for role, image in (("reference", comparison.reference), ("test", comparison.test))
        for key in ("variant", "filter", "sampler", "sensor", "sampling", "environment", "command")
        if key in image.metadata
    ]
    how = "".join(f"<tr><th>{role}<td>{key}<td><code>{html.escape(text)}</code>" for role, key, text in made)
    details = f"<details><summary>How the images were made</summary><table>{how}</table></details>" if made else ""
    body = (
        f"<h1>{html.escape(title)} {_badge(comparison.status.value)}</h1>"
        f"<p class=names>reference <code>{html.escape(comparison.reference.name)}</code>, "
        f"test <code>{html.escape(comparison.test.name)}</code>, {width} &times; {height} pixels</p>"
        f"<table class=tiers>{rows}</table><ul>{remarks}</ul>"
        f"<img src='data:image/png;base64,{base64.b64encode(picture).decode()}' alt='maps of the difference'>"
        f"<p class=foot>{marker}The numbers are in <a href='{NUMBERS}'>{NUMBERS}</a>, the maps at full precision in "
        f"<a href='{MAPS}'>{MAPS}</a>.</p>{details}"
    )
    return _document(title, body)


def _badge(status: str) -> str:
    return f"<span class='badge {status}'>{status}</span>"


def _document(title: str, body: str) -> str:
    return f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title>{_STYLE}<body>{body}\n"


_STYLE = """<meta name=viewport content="width=device-width"><style>
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1180px; padding: 0 1.5rem }
img { max-width: 100% } code { overflow-wrap: anywhere } details { font-size: .85rem }
td, th { text-align: left; vertical-align: top; padding: .35rem 1rem .35rem 0 }
.badge { font-size: .8rem; padding: .2em .6em; border-radius: .3em; text-transform: uppercase }
.pass { background: #d8f0de } .fail { background: #fbdcd8 } .warn { background: #fdedc8 }
.skipped { background: #e9e9ec } .names, .foot { color: #57575c }
</style>"""
