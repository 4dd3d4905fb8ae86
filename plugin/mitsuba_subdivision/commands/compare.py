"""The commands ``compare``, ``accept`` and ``merge``."""

from __future__ import annotations

import argparse
import json
import os
import shlex
from pathlib import Path

from ..messages import PROGRAM, print_remark, print_result
from ..regression import RegressionError, renders
from ..regression.compare import MISSING
from ..regression.compare import compare as compare_images
from ..regression.image import load_image, require_finite, save_image
from ..regression.report import write_report
from ..regression.scene import BOX, load_scene
from ..regression.tiers import DEFAULT_TIERS, TIERS, Status, Tolerances
from ..variants import variant_set
from ..whole_file import require_folder, require_writable, write_text
from .arguments import CommandParser, checked, positive, seed, table

# Exit status of ``compare`` and ``merge`` for unusable input or output, as 1 and 2 are results of comparisons.
UNUSABLE = 3
TOLERANCES = f"Tolerances: {', '.join(Tolerances().as_dict())}."


def compare(parser: CommandParser) -> None:
    """Add the options of ``compare``."""
    parser.description = (
        "Compare an image with a reference, or render a scene as its reference was rendered and compare the two.\n\n"
        + table("tiers", TIERS)
    )
    parser.epilog = f"{TOLERANCES}\n\nExit status: 0 pass, 1 warning, 2 fail, 3 unusable input or output."
    add = parser.add_argument
    add("reference", type=Path, metavar="REFERENCE", help="OpenEXR file")
    add("test", type=Path, metavar="TEST", help="OpenEXR file, or a Mitsuba scene (.xml) to render")
    default = f"default: {', '.join(DEFAULT_TIERS)} as far as images allow; flip if no other compares pixels"
    add("--tiers", metavar="TIERS", help=f"tiers to compare by, separated by commas ({default})")
    add("--spp", type=positive, metavar="N", help="samples per pixel of a scene (default: 256)")
    add("--seed", type=seed, metavar="N", help="seed of the samples of a scene (default: 0)")
    add_tolerances(parser, "tolerance to use instead of the reference's; can be repeated")
    text = "effect of channels that only one image has"
    add("--missing-channels", choices=list(MISSING), default="warn", help=f"{text} (default: %(default)s)")
    add("--json", metavar="FILE", help='write the numbers as JSON; "-" is standard output')
    add("--html", type=Path, metavar="DIR", help="folder to write a report to")
    parser.set_defaults(run=_compare, error_status=UNUSABLE, usage_status=UNUSABLE)


def accept(parser: CommandParser) -> None:
    """Add the options of ``accept``."""
    parser.description = (
        "Make references of the pictures of failed tests, after a look at their reports. The scenes are rendered with "
        "the references' samples; if these show other pictures, nothing is replaced."
    )
    parser.epilog = "Exit status: 0 accepted, 3 unusable input or output, or another picture."
    parser.add_argument("reports", type=Path, metavar="DIR", help="report of a test, or folder with such reports")
    parser.set_defaults(run=_accept, error_status=UNUSABLE, usage_status=UNUSABLE)


def merge(parser: CommandParser) -> None:
    """Add the options of ``merge``."""
    parser.description = 'Merge the passes of an image, which "render --pass" wrote.'
    parser.epilog = "Exit status: 0 merged, 3 unusable input or output."
    parser.add_argument("passes", type=Path, nargs="+", metavar="PASS", help="OpenEXR file of a pass")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="OpenEXR file to write")
    parser.set_defaults(run=_merge, error_status=UNUSABLE, usage_status=UNUSABLE)


def _tolerance(text: str) -> tuple[str, float]:
    name, value = text.split("=", 1)
    return name, float(value)


def add_tolerances(group: argparse._ActionsContainer, text: str) -> None:
    """Add the option ``--tolerance``, with a text for the help."""
    kind = checked(_tolerance, lambda _: True, "NAME=NUMBER")
    group.add_argument(
        "--tolerance", dest="tolerances", metavar="NAME=VALUE", type=kind, action="append", default=[], help=text
    )


def _compare(options: argparse.Namespace) -> int:
    is_scene = options.test.suffix.lower() == ".xml"
    given = "--spp" if options.spp else "--seed" if options.seed is not None else None
    if given and not is_scene:
        raise RegressionError(f'{given} is for a scene; "{options.test}" is rendered already')
    if not options.reference.is_file():
        making = f"{PROGRAM} render SCENE -o {shlex.quote(str(options.reference))} --reference"
        raise RegressionError(f'there is no reference "{options.reference}"; make it with: {making}')
    reference = load_image(options.reference)
    stored = Tolerances().with_values(reference.metadata.get("tolerances", {}))
    tolerances = stored.with_values(dict(options.tolerances))
    tiers = options.tiers.split(",") if options.tiers else None
    test = None if is_scene else load_image(options.test)
    if options.json and options.json != "-":
        require_writable(Path(options.json), [options.reference, options.test])
    if options.html:
        require_folder(options.html)
        require_writable(options.html / "index.html")
    how = {"tiers": tiers, "tolerances": tolerances, "missing": options.missing_channels}
    if test is None:
        with variant_set(renders.variant_for(reference)):
            spp, seed = options.spp or renders.TEST_SPP, options.seed or 0
            comparison = renders.compare_scene(reference, options.test, spp, seed, **how)
    else:
        comparison = compare_images(reference, test, **how)
    text = json.dumps(comparison.as_dict(), indent=1)
    if options.json and options.json != "-":
        write_text(Path(options.json), f"{text}\n")
    # The result comes first, also if the report cannot be written.
    print_result(text if options.json == "-" else comparison)
    page = write_report(options.html, comparison) if options.html else None
    if page and options.json == "-":
        print_remark(f"report: {page}")
    elif page:
        print_result(f"  report: {page}")
    return comparison.exit_status


def _accept(options: argparse.Namespace) -> None:
    found = sorted(options.reports.rglob("comparison.json"))
    failed = [path.parent for path in found if json.loads(path.read_text())["status"] == "fail"]
    if not failed:
        raise RegressionError(f"there is no report of a failed test in {options.reports}")
    for folder in failed:
        seen = load_image(folder / "test.exr")
        if not {"scene", "reference"} <= seen.metadata.keys():
            raise RegressionError(f'"{folder}" is of a scene in memory; accept it with pytest --render-update')
        scene, path = (Path(os.path.relpath(folder / seen.metadata[key])) for key in ("scene", "reference"))
        before = renders.load_reference(path)
        require_writable(path)
        tolerances = Tolerances().with_values(before.metadata["tolerances"])
        with variant_set(seen.metadata["variant"]):
            loaded = load_scene(scene, seen.metadata["parameters"], BOX, seen.metadata["sensor"])
            image = renders.render_pass(loaded, renders.sampling_of(before), with_probe=True)
        again = compare_images(image, seen, ["paired", "tile"], tolerances, missing="ignore")
        if again.status is Status.FAIL or loaded.files != seen.metadata["files"]:
            raise RegressionError(f'"{scene}" has changed since the report "{folder}"; expected its picture\n{again}')
        save_image(path, renders.as_reference(image, scene, path, tolerances))
        print_result(path)


def _merge(options: argparse.Namespace) -> None:
    if options.output.suffix.lower() != ".exr":
        raise RegressionError(f'output "{options.output}"; expected a name ending in .exr')
    passes = [load_image(path) for path in options.passes]
    for image in passes:
        require_finite(image)
    merged = renders.merge_passes(passes, str(options.output))
    require_writable(options.output, options.passes)
    save_image(options.output, merged)
    if missing := renders.missing_passes(merged):
        count = merged.metadata["sampling"].get("passes", 1)
        print_remark(f"warning: of {count} passes, these are missing: {', '.join(map(str, missing))}")
    print_result(options.output)
