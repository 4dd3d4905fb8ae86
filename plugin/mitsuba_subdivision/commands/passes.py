"""Options of ``render`` for rendering by passes and for references, and their implementation."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

import mitsuba as mi

from ..messages import print_result
from ..regression import RegressionError
from ..regression.scene import BOX, LoadedScene, load_scene
from ..regression.tiers import Tolerances
from ..studio.studio_entries import sampler
from ..whole_file import require_writable
from .arguments import positive
from .pictures import threads

TOLERANCES = f"Tolerances: {', '.join(Tolerances().as_dict())}."


def add_pass_options(render: argparse.ArgumentParser) -> None:
    """Add the options for rendering by passes to the command ``render``."""
    render.add_argument("--filter", help='reconstruction filter instead of the scene\'s; "box" is deterministic')
    group = render.add_argument_group(
        "rendering by passes", "The image is an OpenEXR file with the variance and the number of samples of each pixel."
    )
    add = group.add_argument
    add("--pass", dest="share", type=_share, metavar="I/N", help='render only pass I of N; "merge" puts them together')
    add("--passes", type=positive, metavar="N", help="render N passes one after the other, and merge")
    text = "render the passes, or the frames of a model, on the Dask cluster of this scheduler"
    add("--dask", metavar="ADDRESS", help=text)
    add("--batch", type=positive, metavar="N", help="samples per pixel that are rendered with one seed (default: 64)")
    text = 'write a reference for "compare": with the box filter, geometry AOVs and tolerances'
    add("--reference", action="store_true", help=text)
    add_tolerances(group, "tolerance to store with the reference; can be repeated")
    render.epilog = TOLERANCES


def add_tolerances(group: argparse._ActionsContainer, text: str) -> None:
    """Add the option ``--tolerance``, with a text for the help."""
    group.add_argument(
        "--tolerance", dest="tolerances", metavar="NAME=VALUE", type=_tolerance, action="append", default=[], help=text
    )


def wants_passes(options: argparse.Namespace) -> bool:
    """Whether the options of ``render`` ask for rendering by passes. A worker renders a frame as a whole."""
    on_cluster = options.dask and not (options.frames or options.turntable or options.shutter)
    return bool(options.share or options.passes or options.reference or on_cluster)


def validate_pass_options(options: argparse.Namespace) -> None:
    """Raise RegressionError for options of ``render`` that contradict each other, or have no effect with the others."""
    if wants_passes(options) and options.output.suffix.lower() != ".exr":
        raise RegressionError(f'output "{options.output}"; expected a name ending in .exr, which keeps the variance')
    if options.share and (options.passes or options.dask):
        raise RegressionError("--pass renders one pass, --passes and --dask render all; expected one of them")
    if options.reference and options.filter not in (None, BOX):
        raise RegressionError(f'references have the filter "{BOX}", not "{options.filter}"')
    if options.denoise and wants_passes(options):
        raise RegressionError(
            "--denoise removes the noise that passes and references measure; expected no --pass, --passes, --dask or "
            "--reference beside it"
        )
    if options.denoise and options.filter not in (None, BOX):
        raise RegressionError(f'--denoise needs the filter "{BOX}", not "{options.filter}"')
    if options.sensor and wants_passes(options):
        others = "--pass, --passes, --dask or --reference"
        raise RegressionError(f"--sensor is for whole images; expected no {others} beside it")
    if options.batch and not wants_passes(options):
        raise RegressionError("--batch is for passes; expected --pass, --passes, --dask or --reference beside it")
    if options.tolerances and not options.reference:
        raise RegressionError("--tolerance is stored with a reference; expected --reference beside it")


def render_by_passes(options: argparse.Namespace, load: Callable[[], LoadedScene] | None = None) -> None:
    """Render by passes according to the options of ``render``, in the current variant, and write the image.

    A model is loaded by ``load``, here and on the workers of a cluster; it must be picklable.
    Raises RegressionError if there are fewer batches than passes, or no cluster answers.
    """
    from ..regression.image import save_image
    from ..regression.passes import BATCH, LEAST_BATCHES, Sampling, merge_passes, render_on_cluster, render_pass
    from ..regression.references import REFERENCE_SPP, as_reference

    filter_name = BOX if options.reference else options.filter
    is_model = load is not None
    if load is None:
        # Workers may be in another folder.
        path = options.scene.resolve() if options.dask else options.scene
        load = partial(load_scene, path, dict(options.parameters), filter_name)
    loaded = load()
    require_writable(options.output, loaded.file_paths)
    spp = options.spp or (REFERENCE_SPP if options.reference else loaded.sensor.sampler().sample_count())
    tolerances = Tolerances().with_values(dict(options.tolerances))
    number, count = options.share or (1, options.passes or 1)
    batch = options.batch or min(BATCH, max(1, spp // max(LEAST_BATCHES, count)))
    if is_model:
        # Mitsuba would round each batch up, and more samples than recorded would count.
        batch = sampler(batch)["sample_count"]
    sampling = Sampling(max(1, -(-spp // batch)), batch, options.seed)
    settings = {"with_probe": options.reference}
    with threads(options.threads):
        if options.dask:
            variant = str(mi.variant())
            image = render_on_cluster(options.dask, load, variant, sampling, options.passes or 0, **settings)
        elif options.share:
            image = render_pass(loaded, sampling, number, count, **settings)
        else:
            image = merge_passes([render_pass(loaded, sampling, i, count, **settings) for i in range(1, count + 1)])
    if options.reference:
        image = as_reference(image, options.scene, options.output, sampling, tolerances)
    save_image(options.output, image)
    print_result(options.output)


def _share(text: str) -> tuple[int, int]:
    number, _, count = text.partition("/")
    if not (number.isdigit() and count.isdigit() and 1 <= int(number) <= int(count)):
        raise argparse.ArgumentTypeError(f'"{text}"; expected I/N with I from 1 to N, such as 2/8')
    return int(number), int(count)


def _tolerance(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f'"{text}"; expected NAME=NUMBER') from None
