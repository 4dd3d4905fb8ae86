"""The report of a comparison: one static HTML page, its numbers as JSON, and its maps as an OpenEXR file.

Which panels a tier has is decided in the tier's own file.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..whole_file import whole_file
from . import ImageError
from .comparison import Comparison
from .exr import write_channels
from .flip_tier import NAME as FLIP
from .flip_tier import flip_panel
from .panel import Panel, relative_panel
from .png import colours, png_bytes, srgb
from .tier import Status
from .tiers import TIERS

PAGE, NUMBERS, MAPS = "index.html", "comparison.json", "maps.exr"


def write_report(folder: str | Path, comparison: Comparison, title: str | None = None) -> Path:
    """Write the report of a comparison.

    Parameters
    ----------
    folder : str or Path
        Where to write ``index.html``, which needs no other file, ``comparison.json`` and ``maps.exr``.
    title : str, optional
        Title of the page, by default the reference's name.

    Returns
    -------
    Path
        The page.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    title = title or comparison.reference.name
    maps = {name: values for tier in comparison.tiers for name, values in tier.maps.items()}
    if maps:
        write_channels(folder / MAPS, maps)
    numbers = {"title": title, **comparison.as_dict()}
    _write_text(folder / NUMBERS, json.dumps(numbers, indent=1) + "\n")
    _write_text(folder / PAGE, _page(title, comparison, list(_panels(comparison))))
    return folder / PAGE


def write_index(folder: str | Path) -> Path | None:
    """Write a page that links to the reports in a folder, the failed ones first; None if there are none."""
    folder = Path(folder)
    rows = []
    for path in sorted(folder.glob(f"*/{NUMBERS}")):
        found = json.loads(path.read_text(encoding="utf-8"))
        tiers = ", ".join(f"{name} {tier['status']}" for name, tier in found["tiers"].items())
        link = f'<a href="{html.escape(path.parent.name)}/{PAGE}">{html.escape(found["title"])}</a>'
        rows.append((found["status"], f"<tr><td>{_badge(found['status'])}<td>{link}<td>{html.escape(tiers)}"))
    if not rows:
        return None
    order = ["fail", "warn", "pass"]
    lines = [line for _, line in sorted(rows, key=lambda row: order.index(row[0]))]
    body = f"<h1>Render-difference tests</h1><table class=tiers>{''.join(lines)}</table>"
    _write_text(folder / PAGE, _document("Render-difference tests", body))
    return folder / PAGE


def _panels(comparison: Comparison) -> Iterable[Panel]:
    """Both images, their relative difference, and the panels of the tiers: those of the radiance before the others."""
    reference, test = comparison.reference, comparison.test
    a, b = reference.pixels, test.pixels
    finite = np.isfinite(a).all() and np.isfinite(b).all()
    peak = np.nanpercentile(np.where(np.isfinite(a), a, np.nan), 99.5) if np.isfinite(a).any() else 1.0
    scale = 1 / peak if peak > 0 else 1.0
    exposure = f"sRGB at {np.log2(scale):+.1f} stops"
    yield Panel("Reference", srgb(a * scale), exposure)
    yield Panel("Test", srgb(b * scale), exposure + ("" if finite else ", not finite in magenta"))
    if not finite:
        return
    yield relative_panel("Relative difference", a, b, "(test &minus; reference) / reference, mean of R, G, B")
    results = {result.name: result for result in comparison.tiers if result.status is not Status.SKIPPED}
    # The tiers of the radiance first; sorting keeps the order of the table otherwise.
    for name in sorted(TIERS, key=lambda name: not TIERS[name].compares_radiance):
        if name in results:
            yield from TIERS[name].panels(reference, test, results[name])
        elif name == FLIP:
            yield from _flip_besides(comparison)


def _flip_besides(comparison: Comparison) -> Iterable[Panel]:
    """FLIP's panel where its tier did not run, for inspection; none where FLIP is not installed."""
    try:
        found = TIERS[FLIP].compare(comparison.reference, comparison.test, comparison.tolerances, 1)
    except ImageError:
        return
    yield flip_panel(found.maps["flip"], "; noisy images score high, it does not count here")


def _page(title: str, comparison: Comparison, panels: list[Panel]) -> str:
    rows = "".join(
        f"<tr><th>{tier.name}<td>{_badge(tier.status.value)}<td>{'<br>'.join(map(html.escape, tier.lines))}"
        for tier in comparison.tiers
    )
    remarks = "".join(f"<li>{html.escape(line)}" for line in comparison.remarks())
    sheet = "".join(_figure(panel, comparison) for panel in panels)
    marker = "Dashed circle: worst pixel. " if comparison.worst else ""
    body = (
        f"<h1>{html.escape(title)} {_badge(comparison.status.value)}</h1>"
        f"<p class=names>reference <code>{html.escape(comparison.reference.name)}</code>, "
        f"test <code>{html.escape(comparison.test.name)}</code>, {comparison.reference.size[0]} &times; "
        f"{comparison.reference.size[1]} pixels</p>"
        f"<table class=tiers>{rows}</table><ul>{remarks}</ul><div class=sheet>{sheet}</div>"
        f"<p class=foot>{marker}The numbers are in <a href='{NUMBERS}'>{NUMBERS}</a>, the maps at full precision in "
        f"<a href='{MAPS}'>{MAPS}</a>.</p>{_how_made(comparison)}"
    )
    return _document(title, body)


def _figure(panel: Panel, comparison: Comparison) -> str:
    height, width = panel.pixels.shape[:2]
    data = base64.b64encode(png_bytes(panel.pixels)).decode()
    marks = [(f"x={t['x']} y={t['y']} width={t['width']} height={t['height']}", t) for t in _one_of_each(panel.tiles)]
    # The white halos of all rectangles first, so that none hides a line.
    shapes = "".join(f"<rect class=halo {mark} />" for mark, _ in marks)
    shapes += "".join(
        f"<rect {mark}><title>{t['width']} &times; {t['height']}, {t['channel']}, z = {t['z']:+.1f}</title></rect>"
        for mark, t in marks
    )
    if comparison.worst:
        x, y = comparison.worst.x + 0.5, comparison.worst.y + 0.5
        shapes += f"<circle cx={x} cy={y} r={max(width, height) / 28:.3g} />"
    legend = ""
    if panel.colour_map:
        bar = base64.b64encode(png_bytes(colours(np.linspace(0, 1, 128)[None], panel.colour_map))).decode()
        low, high = panel.ends
        legend = (
            f"<div class=bar><span>{low}</span><img src='data:image/png;base64,{bar}' alt=''><span>{high}</span></div>"
        )
    return (
        f"<figure><h2>{panel.title}</h2><svg viewBox='0 0 {width} {height}' role=img aria-label='{panel.title}'>"
        f"<image href='data:image/png;base64,{data}' width={width} height={height} />{shapes}</svg>"
        f"{legend}<figcaption>{panel.caption}</figcaption></figure>"
    )


def _one_of_each(tiles: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The strongest channel of each tile, large tiles first so that small ones lie above them."""
    strongest: dict[tuple[int, int, int, int], Mapping[str, Any]] = {}
    for tile in sorted(tiles, key=lambda tile: abs(tile["z"])):
        strongest[tile["x"], tile["y"], tile["width"], tile["height"]] = tile
    return sorted(strongest.values(), key=lambda tile: -tile["width"] * tile["height"])


def _how_made(comparison: Comparison) -> str:
    rows = []
    for role, image in (("reference", comparison.reference), ("test", comparison.test)):
        for key in ("variant", "filter", "sampling", "environment", "command"):
            if key in image.metadata:
                value = image.metadata[key]
                text = value if isinstance(value, str) else json.dumps(value)
                rows.append(f"<tr><th>{role}<td>{key}<td><code>{html.escape(text)}</code>")
    return (
        f"<details><summary>How the images were made</summary><table>{''.join(rows)}</table></details>" if rows else ""
    )


def _badge(status: str) -> str:
    return f"<span class='badge {status}'>{status}</span>"


def _document(title: str, body: str) -> str:
    return f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title>{_STYLE}<body>{body}\n"


def _write_text(path: Path, text: str) -> None:
    with whole_file(path) as beside:
        beside.write_text(text, encoding="utf-8")


_STYLE = """<meta name=viewport content="width=device-width"><style>
body { font: 15px/1.45 system-ui, sans-serif; color: #1d1d1f; background: #fff; margin: 2rem auto; max-width: 1180px;
  padding: 0 1.5rem }
h1 { font-size: 1.5rem; margin: 0 } h2 { font-size: 1rem; margin: 0 0 .4rem }
.names, .foot, figcaption { color: #57575c } .names { margin: .2rem 0 1.2rem }
table { border-collapse: collapse; margin: .5rem 0 } td, th { text-align: left; vertical-align: top;
  padding: .35rem 1rem .35rem 0; font-weight: normal } .tiers tr { border-top: 1px solid #e3e3e6 }
.tiers th { font-weight: 600 } ul { margin: 1rem 0; padding-left: 1.2rem }
.badge { font: 600 .8rem/1 system-ui, sans-serif; padding: .22em .6em; border-radius: .3em; vertical-align: middle;
  text-transform: uppercase; letter-spacing: .03em }
.pass { background: #d8f0de; color: #10562a } .fail { background: #fbdcd8; color: #8d1c10 }
.warn { background: #fdedc8; color: #6c4a00 } .skipped { background: #e9e9ec; color: #4c4c52 }
.sheet { display: grid; grid-template-columns: repeat(auto-fill, minmax(255px, 1fr)); gap: 1.6rem 1.2rem }
figure { margin: 0 } figcaption { font-size: .85rem; margin-top: .25rem }
svg { width: 100%; display: block; background: #eee } svg image { image-rendering: pixelated }
rect { fill: none; stroke: #000; stroke-width: 2; vector-effect: non-scaling-stroke; pointer-events: all }
.halo { stroke: #fff; stroke-width: 5; stroke-opacity: .75 }
circle { fill: none; stroke: #ff2d9b; stroke-width: 2; stroke-dasharray: 4 2; vector-effect: non-scaling-stroke }
.bar { display: flex; gap: .5rem; align-items: center; font-size: .85rem; margin-top: .35rem }
.bar img { flex: 1; min-width: 0; height: 10px } details { margin: 1rem 0 3rem; font-size: .85rem }
code { font-size: .92em; overflow-wrap: anywhere }
</style>"""
