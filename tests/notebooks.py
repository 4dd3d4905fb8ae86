"""Run the notebooks of the guide and store what they show.

Each runs from its first cell to its last in a new kernel and an empty folder, and is written back without anything that
changes from run to run: times, versions, names of machines. An error or a warning of a cell ends the program, and the
notebook stays as it was.

The metadata of a cell may have ``"tests": {"replace": ["A", "B", ..]}``: with ``--quick``, A is then B in its code.
"""

import argparse
import base64
import io
import os
import re
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).resolve().parents[1] / "plugin" / "guide" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
# Mitsuba's bitmaps show themselves as HTML, which not all viewers of notebooks take.
BITMAP = re.compile(r'<img src="data:(image/\w+);base64,\s*([^"]+)"')
PICTURES = ("image/png", "image/jpeg")
JPEG_QUALITY = 90
# Seconds for a cell.
TIMEOUT = 300


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("notebooks", nargs="*", type=Path, default=NOTEBOOKS, help="default: all of the guide")
    parser.add_argument("--quick", action="store_true", help="with the replacements of the tests")
    parser.add_argument("--output", type=Path, help="folder to write to, in place of the notebooks' own")
    options = parser.parse_args()
    for path in options.notebooks:
        notebook = executed(nbformat.read(path, as_version=4), options.quick)
        target = path if options.output is None else options.output / path.name
        nbformat.write(notebook, target)
        print(f"{target.name}: {target.stat().st_size / 1000:.0f} kB")


def executed(notebook: nbformat.NotebookNode, quick: bool) -> nbformat.NotebookNode:
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for cell in cells if quick else ():
        replace_for_tests(cell)
    with tempfile.TemporaryDirectory() as folder:
        # Neither a user's settings nor another backend for plots.
        environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
        environment |= {"IPYTHONDIR": folder, "JUPYTER_CONFIG_DIR": folder}
        quick_kernels = f"--IPKernelApp.exec_files={Path(__file__).with_name('quick_kernels.py')}"
        client = NotebookClient(notebook, timeout=TIMEOUT, resources={"metadata": {"path": folder}})
        client.extra_arguments = ["--log-level=ERROR", *([quick_kernels] if quick else [])]
        # What a cell prints is one output, however it arrives.
        client.coalesce_streams = True
        client.execute(env=environment)
    for cell in cells:
        cell.metadata.pop("execution", None)
        for output in cell.outputs:
            tidy(output, cell)
    notebook.metadata.language_info = {"name": "python"}
    return notebook


def replace_for_tests(cell: nbformat.NotebookNode) -> None:
    words = cell.metadata.get("tests", {}).get("replace", [])
    for old, new in zip(words[::2], words[1::2], strict=True):
        if old not in cell.source:
            raise SystemExit(f'cell "{cell.id}" is to have "{old}" replaced, which is not in it')
        cell.source = cell.source.replace(old, new)


def tidy(output: nbformat.NotebookNode, cell: nbformat.NotebookNode) -> None:
    """Reduce a picture to its pixels, as PNG or JPEG, and all outputs to what does not change; refuse warnings."""
    if output.output_type == "stream":
        # Mitsuba's own warnings go to the other stream.
        if output.name == "stderr" or " WARN " in output.text:
            raise SystemExit(f'cell "{cell.id}" warns: {output.text}')
        return
    bitmap = BITMAP.search(output.data.get("text/html", ""))
    if bitmap:
        del output.data["text/html"]
        output.data[bitmap[1]] = bitmap[2]
    if has_picture(output):
        # It needs no description of the object that it shows.
        output.data.pop("text/plain", None)
        (kind,) = output.data
        written = io.BytesIO()
        # Mitsuba stores noise at the highest quality.
        picture(output).save(written, kind.removeprefix("image/"), optimize=True, quality=JPEG_QUALITY)
        output.data[kind] = base64.b64encode(written.getvalue()).decode()
    output.metadata.clear()


def has_picture(output: nbformat.NotebookNode) -> bool:
    return any(kind in output.get("data", {}) for kind in PICTURES)


def picture(output: nbformat.NotebookNode) -> Image.Image:
    (data,) = (output.data[kind] for kind in PICTURES if kind in output.data)
    return Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")


if __name__ == "__main__":
    main()
