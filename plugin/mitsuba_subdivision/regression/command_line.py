"""The commands ``compare`` and ``merge``, and rendering by passes for ``render``."""

from __future__ import annotations

import argparse
import json
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

from ..messages import tell, tell_aside
from ..whole_file import require_folder, require_writable, whole_file

UNUSABLE = 3


def add_commands(commands: Any) -> None:
    """Add the commands to the subparsers of the program; ``run`` of their options returns the exit status."""
    compare = commands.add_parser(
        "compare",
        help="compare two pictures, or a scene with its reference",
        description="Compare a picture with a reference, both OpenEXR files; or render a scene as its reference was, "
        "and compare it.",
        epilog="Exit status: 0 pass, 1 warning, 2 fail, 3 unusable input or output.",
    )
    compare.add_argument("reference", type=Path, metavar="REF", help="reference, an OpenEXR file")
    compare.add_argument("test", type=Path, metavar="TEST", help="OpenEXR file, or a Mitsuba scene (.xml) to render")
    compare.add_argument(
        "--tiers", help="tiers, separated by commas: probe, paired, tile, flip (default: by the files)"
    )
    compare.add_argument("--spp", type=positive, help="samples per pixel of a scene (default: 256)")
    _add_tolerances(compare, "another tolerance than the reference's")
    compare.add_argument("--json", metavar="FILE", help='file for the numbers, "-" for standard output')
    compare.add_argument("--html", type=Path, metavar="DIR", help="folder for a report")
    compare.set_defaults(run=_compare, error_status=UNUSABLE)
    _usage_errors_exit_with(compare, UNUSABLE)

    merge = commands.add_parser(
        "merge",
        help="merge passes of a picture",
        description='Merge passes that "render --pass" wrote.',
        epilog="Exit status: 0 merged, 3 unusable input or output.",
    )
    merge.add_argument("passes", type=Path, nargs="+", metavar="PASS", help="OpenEXR file of a pass")
    merge.add_argument("-o", "--output", type=Path, required=True, help="OpenEXR file to write")
    merge.set_defaults(run=_merge, error_status=UNUSABLE)
    _usage_errors_exit_with(merge, UNUSABLE)


def add_render_options(render: argparse.ArgumentParser) -> None:
    """Add the options of rendering by passes to the command ``render``."""
    group = render.add_argument_group("rendering by passes", "Pictures with variance and number of samples, as .exr.")
    group.add_argument(
        "--pass", dest="share", type=_share, metavar="I/N", help="render the I-th of N passes, to be merged later"
    )
    group.add_argument("--passes", type=positive, metavar="N", help="render N passes one after the other, and merge")
    group.add_argument("--dask", metavar="ADDRESS", help="render the passes on the Dask cluster of this scheduler")
    group.add_argument(
        "--batch", type=positive, metavar="SPP", help="samples that are rendered at once, under a seed (default: 64)"
    )
    group.add_argument("--filter", help="reconstruction filter in place of the scene's; box repeats to the bit")
    group.add_argument(
        "--reference", action="store_true", help="write a reference: with box filter, geometry probe and tolerances"
    )
    _add_tolerances(group, "tolerance to store with a reference")


def _add_tolerances(parser: Any, text: str) -> None:
    parser.add_argument(
        "--tolerance", dest="tolerances", metavar="NAME=VALUE", type=_tolerance, action="append", default=[], help=text
    )


def wants_passes(options: argparse.Namespace) -> bool:
    """Whether the options of ``render`` ask for what `render_by_passes` does."""
    return bool(options.share or options.passes or options.dask or options.reference)


def check_render_options(options: argparse.Namespace) -> None:
    """Refuse options of ``render`` that contradict each other, or do nothing beside the others.

    Raises
    ------
    RegressionError
    """
    from .errors import RegressionError
    from .scene import BOX

    if wants_passes(options) and options.output.suffix.lower() != ".exr":
        raise RegressionError(f'output "{options.output}"; expected a name ending in .exr, which keeps the variance')
    if options.share and (options.passes or options.dask):
        raise RegressionError("--pass renders one pass, --passes and --dask render all; expected only one of them")
    if options.reference and options.filter not in (None, BOX):
        raise RegressionError(f'references have the filter "{BOX}", not "{options.filter}"')
    if options.batch and not wants_passes(options):
        raise RegressionError("--batch is for passes; expected --pass, --passes, --dask or --reference beside it")
    if options.tolerances and not options.reference:
        raise RegressionError("--tolerance is stored with a reference; expected --reference beside it")


def render_by_passes(options: argparse.Namespace) -> None:
    """Render what the options of ``render`` ask for, in the current variant, and write it.

    Raises
    ------
    RegressionError
        If there are fewer batches than passes, or the cluster is not there.
    """
    import mitsuba as mi

    from ..images.picture import save_picture
    from ..images.tolerances import Tolerances
    from .cluster import render_on_cluster
    from .passes import BATCH, Sampling, merge_passes, render_pass
    from .reference import REFERENCE_SPP, as_reference
    from .scene import BOX, load_scene

    filter_name = BOX if options.reference else options.filter
    parameters = dict(options.parameters)
    loaded = load_scene(options.scene, parameters, filter_name)
    require_writable(options.output, loaded.file_paths)
    spp = options.spp or (REFERENCE_SPP if options.reference else loaded.sensor.sampler().sample_count())
    tolerances = Tolerances().with_values(dict(options.tolerances))
    number, count = options.share or (1, options.passes or 1)
    batch = options.batch or min(BATCH, max(1, spp // max(2, count)))
    sampling = Sampling(max(1, -(-spp // batch)), batch, options.seed)
    settings = {"with_probe": options.reference}
    if options.dask:
        picture = render_on_cluster(
            options.dask,
            options.scene,
            parameters,
            mi.variant(),
            sampling,
            options.passes or 0,
            filter_name,
            **settings,
        )
    elif options.share:
        picture = render_pass(loaded, sampling, number, count, **settings)
    else:
        picture = merge_passes([render_pass(loaded, sampling, i, count, **settings) for i in range(1, count + 1)])
    if options.reference:
        picture = as_reference(picture, options.scene, options.output, sampling, tolerances)
    save_picture(options.output, picture)
    tell(options.output)


def positive(text: str) -> int:
    """Argument that is an integer of at least 1."""
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'"{text}"; expected an integer, 1 or more') from None
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number}; expected 1 or more")
    return number


def _share(text: str) -> tuple[int, int]:
    number, _, count = text.partition("/")
    if not (number.isdigit() and count.isdigit() and 1 <= int(number) <= int(count)):
        raise argparse.ArgumentTypeError(f'"{text}"; expected I/N with I from 1 to N, such as 2/8')
    return int(number), int(count)


def _usage_errors_exit_with(parser: argparse.ArgumentParser, status: int) -> None:
    """Give a parser's usage errors another status than Argparse's 2, which would say that the pictures differ."""
    parse = parser.parse_known_args

    def error(message: str) -> NoReturn:
        parser.print_usage(sys.stderr)
        parser.exit(status, f"{parser.prog}: error: {message}\n")

    def parse_all(*arguments: Any, **keywords: Any) -> tuple[argparse.Namespace, list[str]]:
        options, unknown = parse(*arguments, **keywords)
        if unknown:
            # The parser of the program would say so with its own status.
            error(f"unrecognized arguments: {' '.join(unknown)}")
        return options, unknown

    parser.error, parser.parse_known_args = error, parse_all


def _compare(options: argparse.Namespace) -> int:
    from ..images.compare import compare
    from ..images.errors import ImageError
    from ..images.picture import load_picture
    from ..images.report import write_report
    from ..images.tolerances import Tolerances

    renders = options.test.suffix.lower() == ".xml"
    if options.spp and not renders:
        raise ImageError(f'--spp is for a scene; "{options.test}" is rendered already')
    reference = load_picture(options.reference)
    stored = Tolerances().with_values(reference.metadata.get("tolerances", {}))
    tolerances = stored.with_values(dict(options.tolerances))
    tiers = options.tiers.split(",") if options.tiers else None
    test = None if renders else load_picture(options.test)
    if options.json and options.json != "-":
        require_writable(Path(options.json), [options.reference, options.test])
    if options.html:
        require_folder(options.html)
        require_writable(options.html / "index.html")
    if renders:
        from .check import check_scene, variant_for, variant_set
        from .reference import TEST_SPP

        with variant_set(variant_for(reference)):
            found = check_scene(reference, options.test, tiers, options.spp or TEST_SPP, tolerances)
    else:
        found = compare(reference, test, tiers, tolerances)
    text = json.dumps(found.as_dict(), indent=1)
    if options.json and options.json != "-":
        with whole_file(Path(options.json)) as beside:
            beside.write_text(f"{text}\n", encoding="utf-8")
    page = write_report(options.html, found) if options.html else None
    tell(text if options.json == "-" else found)
    if page and options.json == "-":
        tell_aside(f"report: {page}")
    elif page:
        tell(f"  report: {page}")
    return found.exit_status


def _tolerance(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f'"{text}"; expected NAME=NUMBER') from None


def _merge(options: argparse.Namespace) -> None:
    from ..images.errors import ImageError
    from ..images.picture import load_picture, require_finite, save_picture
    from .passes import merge_passes

    if options.output.suffix.lower() != ".exr":
        raise ImageError(f'output "{options.output}"; expected a name ending in .exr')
    passes = [load_picture(path) for path in options.passes]
    for picture in passes:
        require_finite(picture)
    merged = merge_passes(passes, str(options.output))
    require_writable(options.output, options.passes)
    save_picture(options.output, merged)
    first, *others = merged.metadata["sampling"]["batches"]
    gaps = [*([[0, first[0]]] if first[0] else []), *([a[1], b[0]] for a, b in pairwise([first, *others]))]
    for start, stop in gaps:
        tell_aside(f"warning: no pass has the batches from {start} to {stop - 1}")
    tell(options.output)
