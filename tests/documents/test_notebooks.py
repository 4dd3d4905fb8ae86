"""Every notebook of the guide runs, with its stored outputs."""

import re

import nbformat
import numpy as np
import pytest

pytest.importorskip("nbclient")
from notebooks import FOLDER, NOTEBOOKS, executed, has_picture, picture
from PIL import Image

EVERY_NOTEBOOK = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
# Largest size of a file in bytes: pages of a repository, not an archive of pictures.
LARGEST = 250_000
# Pictures are compared by the mean colours, from 0 to 1, of blocks of so many pixels along each side: few samples per
# pixel make noise. The dark spot is 0.1 and more.
BLOCK, SHADE = 20, 0.08
FRACTION = re.compile(r"\d+\.\d+(?:e-?\d+)?|\d+e-?\d+")
LINK = re.compile(r"(?:^\[\d+\]: |\]\()([^)\s#]+)", flags=re.MULTILINE)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def printed(cell):
    return "".join(output.text for output in cell.outputs if output.output_type == "stream")


def blocks(image):
    size = [round(side / BLOCK) for side in image.size]
    return np.asarray(image.resize(size, Image.Resampling.BOX), dtype=float) / 255


def alike(one, other):
    return one.size == other.size and np.abs(blocks(one) - blocks(other)).max() < SHADE


@EVERY_NOTEBOOK
def test_notebooks_reproduce_their_stored_outputs(path):
    """With fewer samples and steps. What these change, or the processor by its rounding, is marked as "varies"."""
    stored = nbformat.read(path, as_version=4)
    run = executed(nbformat.read(path, as_version=4), quick=True)
    for before, now in zip(code_cells(stored), code_cells(run), strict=True):
        pictured, expected = ([has_picture(output) for output in cell.outputs] for cell in (now, before))
        assert pictured == expected, now.id
        if not before.metadata.get("tests", {}).get("varies"):
            assert printed(now) == printed(before), now.id
            pairs = zip(now.outputs, before.outputs, strict=True)
            assert all(alike(picture(one), picture(other)) for one, other in pairs if has_picture(one)), now.id


@EVERY_NOTEBOOK
def test_a_notebook_is_small_and_complete(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < LARGEST
    counts = [cell.execution_count for cell in code_cells(notebook)]
    assert counts == list(range(1, len(counts) + 1))
    links = [link for cell in notebook.cells for link in LINK.findall(cell.source) if cell.cell_type == "markdown"]
    assert links
    for link in links:
        assert link.startswith("https://") or (FOLDER / link).exists(), link


@EVERY_NOTEBOOK
def test_fractions_in_the_text_of_a_notebook_come_from_its_cells(path):
    notebook = nbformat.read(path, as_version=4)
    shown = "".join(cell.source + printed(cell) for cell in code_cells(notebook))
    text = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    text = re.sub(r"\$.*?\$|\]\(.*?\)|^\[\d+\]: .*$", "", text, flags=re.MULTILINE)
    assert [number for number in FRACTION.findall(text) if number not in shown] == []
