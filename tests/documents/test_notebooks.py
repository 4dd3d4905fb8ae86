"""Every notebook of the guide runs, and what is stored in it is what its code says today."""

import re

import nbformat
import pytest

pytest.importorskip("nbclient")
from notebooks import FOLDER, NOTEBOOKS, executed, has_picture

EVERY_NOTEBOOK = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
# Of a file, in bytes: pages of a repository, not an archive of pictures.
LARGEST = 400_000
LINK = re.compile(r"(?:^\[\d+\]: |\]\()([^)\s#]+)", flags=re.MULTILINE)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def printed(cell):
    return "".join(output.text for output in cell.outputs if output.output_type == "stream")


def test_there_are_three():
    assert [path.stem for path in NOTEBOOKS] == ["dark_spot", "first_picture", "fitting"]


@EVERY_NOTEBOOK
def test_a_notebook_runs_and_shows_what_is_stored(path):
    """With fewer samples and steps. What they change says so in its metadata, as "varies"; pictures may differ."""
    stored = nbformat.read(path, as_version=4)
    found = executed(nbformat.read(path, as_version=4), quick=True)
    for before, now in zip(code_cells(stored), code_cells(found), strict=True):
        assert [has_picture(each) for each in now.outputs] == [has_picture(each) for each in before.outputs], now.id
        if not before.metadata.get("tests", {}).get("varies"):
            assert printed(now) == printed(before), now.id


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
