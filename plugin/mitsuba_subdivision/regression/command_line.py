"""The commands ``compare`` and ``merge``, the options of ``render`` for rendering by passes, and the variant."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

from ..images.tiers import TIERS
from ..images.tolerances import Tolerances
from ..llvm import best_variant
from ..messages import tell, tell_aside
from ..whole_file import require_folder, require_writable, whole_file

# Exit status of ``compare`` and ``merge`` for input or output that cannot be used: 1 and 2 say how images differ.
UNUSABLE = 3
TOLERANCES = f"Tolerances: {', '.join(Tolerances().as_dict())}."


def table(title: str, rows: dict[str, str]) -> str:
    """Names and what they mean, in lines for the help of a command."""
    return "\n".join([f"{title}:", *(f"  {name:<12} {text}" for name, text in rows.items())])


def add_commands(add_parser: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the commands to the program.

    Parameters
    ----------
    add_parser : callable
        Makes the parser of a command from its name and a summary. A command's option ``run`` is the function that
        carries it out and returns the exit status.
    """
    by_default = ", ".join(name for name, tier in TIERS.items() if tier.by_default)
    compare = add_parser(
        "compare",
        "compare two images, or a scene with its reference",
        description="Compare an image with a reference, or render a scene as its reference was rendered and compare "
        "the two.\n\n" + table("tiers", {name: tier.compares for name, tier in TIERS.items()}),
        epilog=f"{TOLERANCES}\n\nExit status: 0 pass, 1 warning, 2 fail, 3 unusable input or output.",
    )
    compare.add_argument("reference", type=Path, metavar="REFERENCE", help="OpenEXR file")
    compare.add_argument("test", type=Path, metavar="TEST", help="OpenEXR file, or a Mitsuba scene (.xml) to render")
    compare.add_argument(
        "--tiers",
        metavar="TIERS",
        help=f"tiers to compare by, separated by commas (default: {by_default}, as far as the images allow; flip if no "
        "other can compare their pixels)",
    )
    compare.add_argument("--spp", type=positive, metavar="N", help="samples per pixel of a scene (default: 256)")
    _add_tolerances(compare, "tolerance to use instead of the reference's; can be given again")
    compare.add_argument("--json", metavar="FILE", help='write the numbers as JSON; "-" is standard output')
    compare.add_argument("--html", type=Path, metavar="DIR", help="folder to write a report to")
    compare.set_defaults(run=_compare, error_status=UNUSABLE)
    _usage_errors_exit_with(compare, UNUSABLE)

    merge = add_parser(
        "merge",
        "merge the passes of an image",
        description='Merge the passes of an image, which "render --pass" wrote.',
        epilog="Exit status: 0 merged, 3 unusable input or output.",
    )
    merge.add_argument("passes", type=Path, nargs="+", metavar="PASS", help="OpenEXR file of a pass")
    merge.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="OpenEXR file to write")
    merge.set_defaults(run=_merge, error_status=UNUSABLE)
    _usage_errors_exit_with(merge, UNUSABLE)


def add_render_options(render: argparse.ArgumentParser) -> None:
    """Add the options for rendering by passes to the command ``render``."""
    render.add_argument("--filter", help='reconstruction filter instead of the scene\'s; "box" repeats to the bit')
    group = render.add_argument_group(
        "rendering by passes", "The image is an OpenEXR file with the variance and the number of samples of each pixel."
    )
    group.add_argument(
        "--pass", dest="share", type=_share, metavar="I/N", help='render only pass I of N; "merge" puts them together'
    )
    group.add_argument("--passes", type=positive, metavar="N", help="render N passes one after the other, and merge")
    group.add_argument("--dask", metavar="ADDRESS", help="render the passes on the Dask cluster of this scheduler")
    group.add_argument(
        "--batch", type=positive, metavar="N", help="samples per pixel that are rendered with one seed (default: 64)"
    )
    group.add_argument(
        "--reference",
        action="store_true",
        help='write a reference for "compare": with box filter, geometry probe and tolerances',
    )
    _add_tolerances(group, "tolerance to store with the reference; can be given again")
    render.epilog = TOLERANCES


def _add_tolerances(group: Any, text: str) -> None:
    group.add_argument(
        "--tolerance", dest="tolerances", metavar="NAME=VALUE", type=_tolerance, action="append", default=[], help=text
    )


def add_variant(parser: argparse.ArgumentParser, *aliases: str) -> None:
    """Add the option ``--variant`` to a command, with other names that it may have."""
    parser.add_argument(
        *aliases,
        "--variant",
        dest="variant",
        metavar="VARIANT",
        help="variant of Mitsuba (default: llvm_ad_rgb where it can run, otherwise scalar_rgb)",
    )


def set_variant(name: str | None) -> None:
    """Set the variant of Mitsuba that ``--variant`` names, or the best if there is none.

    Raises
    ------
    RegressionError
        If the variant cannot run here.
    """
    import mitsuba as mi

    from . import RegressionError
    from .environment import variant_problem

    problem = variant_problem(name) if name else None
    if problem:
        raise RegressionError(problem)
    mi.set_variant(name or best_variant())


def wants_passes(options: argparse.Namespace) -> bool:
    """Whether the options of ``render`` ask for rendering by passes."""
    return bool(options.share or options.passes or options.dask or options.reference)


def validate_render_options(options: argparse.Namespace) -> None:
    """Refuse options of ``render`` that contradict each other, or have no effect with the others.

    Raises
    ------
    RegressionError
    """
    from . import RegressionError
    from .scene import BOX

    if wants_passes(options) and options.output.suffix.lower() != ".exr":
        raise RegressionError(f'output "{options.output}"; expected a name ending in .exr, which keeps the variance')
    if options.share and (options.passes or options.dask):
        raise RegressionError("--pass renders one pass, --passes and --dask render all; expected only one of them")
    if options.reference and options.filter not in (None, BOX):
        raise RegressionError(f'references have the filter "{BOX}", not "{options.filter}"')
    if options.sensor and wants_passes(options):
        raise RegressionError(
            "--sensor is for whole images; expected no --pass, --passes, --dask or --reference beside it"
        )
    if options.batch and not wants_passes(options):
        raise RegressionError("--batch is for passes; expected --pass, --passes, --dask or --reference beside it")
    if options.tolerances and not options.reference:
        raise RegressionError("--tolerance is stored with a reference; expected --reference beside it")


def render_by_passes(options: argparse.Namespace) -> None:
    """Render by passes as the options of ``render`` ask, in the current variant, and write the image.

    Raises
    ------
    RegressionError
        If there are fewer batches than passes, or no cluster answers.
    """
    import mitsuba as mi

    from ..images.image import save_image
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
        image = render_on_cluster(
            options.dask,
            options.scene,
            parameters,
            str(mi.variant()),
            sampling,
            options.passes or 0,
            filter_name,
            **settings,
        )
    elif options.share:
        image = render_pass(loaded, sampling, number, count, **settings)
    else:
        image = merge_passes([render_pass(loaded, sampling, i, count, **settings) for i in range(1, count + 1)])
    if options.reference:
        image = as_reference(image, options.scene, options.output, sampling, tolerances)
    save_image(options.output, image)
    tell(options.output)


def positive(text: str) -> int:
    """Parse an argument that is an integer of at least 1."""
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
    """Make usage errors of a parser end the program with a status of ours: argparse's 2 says that the images differ."""
    parse = parser.parse_known_args
    # Any, as methods of this one parser are replaced.
    changed: Any = parser

    def error(message: str) -> NoReturn:
        parser.print_usage(sys.stderr)
        parser.exit(status, f"{parser.prog}: error: {message}\n")

    def parse_all(*arguments: Any, **keywords: Any) -> tuple[argparse.Namespace, list[str]]:
        options, unknown = parse(*arguments, **keywords)
        if unknown:
            # Otherwise the parser of the program would refuse them, with argparse's status.
            error(f"unrecognized arguments: {' '.join(unknown)}")
        return options, unknown

    changed.error, changed.parse_known_args = error, parse_all


def _compare(options: argparse.Namespace) -> int:
    from ..images import ImageError
    from ..images.compare import compare
    from ..images.image import load_image
    from ..images.report import write_report

    renders = options.test.suffix.lower() == ".xml"
    if options.spp and not renders:
        raise ImageError(f'--spp is for a scene; "{options.test}" is rendered already')
    reference = load_image(options.reference)
    stored = Tolerances().with_values(reference.metadata.get("tolerances", {}))
    tolerances = stored.with_values(dict(options.tolerances))
    tiers = options.tiers.split(",") if options.tiers else None
    test = None if renders else load_image(options.test)
    if options.json and options.json != "-":
        require_writable(Path(options.json), [options.reference, options.test])
    if options.html:
        require_folder(options.html)
        require_writable(options.html / "index.html")
    if test is None:
        from .compare_scene import compare_scene, variant_for, variant_set
        from .reference import TEST_SPP

        with variant_set(variant_for(reference)):
            found = compare_scene(reference, options.test, tiers, options.spp or TEST_SPP, tolerances)
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
    from ..images import ImageError
    from ..images.image import load_image, require_finite, save_image
    from .passes import merge_passes

    if options.output.suffix.lower() != ".exr":
        raise ImageError(f'output "{options.output}"; expected a name ending in .exr')
    passes = [load_image(path) for path in options.passes]
    for image in passes:
        require_finite(image)
    merged = merge_passes(passes, str(options.output))
    require_writable(options.output, options.passes)
    save_image(options.output, merged)
    first, *others = merged.metadata["sampling"]["batches"]
    gaps = [*([[0, first[0]]] if first[0] else []), *([a[1], b[0]] for a, b in pairwise([first, *others]))]
    for start, stop in gaps:
        tell_aside(f"warning: no pass has the batches from {start} to {stop - 1}")
    tell(options.output)
