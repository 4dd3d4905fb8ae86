"""Processes that measure, with the package of this checkout."""

import json
import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[2]


def ran(words, **variables):
    """A command that has ended. Variables of the environment that are None are left out."""
    path = os.pathsep.join([str(ROOT / "plugin"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, **variables}
    environment = {name: value for name, value in environment.items() if value is not None}
    return subprocess.run([str(word) for word in words], capture_output=True, text=True, env=environment, check=False)


def measured(name, words, **variables):
    """What a command prints as JSON, in its last line."""
    done = ran(words, **variables)
    if done.returncode:
        raise SystemExit(f"{name} failed:\n{done.stderr or done.stdout}")
    return json.loads(done.stdout.splitlines()[-1])
