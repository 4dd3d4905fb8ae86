"""Install the built packages in empty environments, and see that each renders.

``python .ci/try_packages.py dist`` does so for the wheel and for the source distribution in the folder ``dist``: a new
environment outside the checkout, the package with the extra ``llvm``, ``mitsuba-subdivision doctor``, and the README's
example in Python.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"
SUFFIXES = (".whl", ".tar.gz")
PICTURE = "rook.png"
# What would lend something of this environment to the new one.
LENT = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")


def main() -> None:
    """Try the packages of a folder; the first command that fails ends all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder with one wheel and one source distribution")
    folder = parser.parse_args().folder
    for suffix in SUFFIXES:
        found = list(folder.glob(f"*{suffix}"))
        if len(found) != 1:
            sys.exit(f'"{folder}" has {len(found)} files *{suffix}; expected one')
        try_package(found[0].resolve())


def try_package(package: Path) -> None:
    """Install a package in an empty environment, and render with it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        venv.create(folder / "environment", with_pip=True)
        programs = folder / "environment" / ("Scripts" if os.name == "nt" else "bin")
        example = folder / "example.py"
        example.write_text(readme_example(), encoding="utf-8")
        for command in (
            [programs / "python", "-m", "pip", "install", "-q", f"{package}[llvm]"],
            [programs / "mitsuba-subdivision", "doctor"],
            [programs / "python", example],
        ):
            words = [str(word) for word in command]
            sys.stdout.write(f"+ {' '.join(words)}\n")
            sys.stdout.flush()
            kept = {name: value for name, value in os.environ.items() if name not in LENT}
            subprocess.run(words, cwd=folder, env=kept, check=True)
        if not (folder / PICTURE).is_file():
            sys.exit(f"{package.name}: the README's example has not written {PICTURE}")


def readme_example() -> str:
    """The README's first block of Python, with few samples."""
    (text, *_) = re.findall(r"^```python\n(.*?)^```$", README.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return text.replace("spp=64", "spp=1")


if __name__ == "__main__":
    main()
