"""The same work by OpenSubdiv and Embree, if their development files are installed."""

import json
import shutil
import signal
import subprocess
from pathlib import Path

HERE = Path(__file__).parent
FLAGS = ["-O3", "-march=native", "-DNDEBUG", "-std=c++17"]
# Source, libraries, and the arguments that come first, of each peer.
PROGRAMS = {
    "opensubdiv far": ("opensubdiv_timing", ["-losdCPU"], ["far"]),
    "opensubdiv bfr": ("opensubdiv_timing", ["-losdCPU"], ["bfr"]),
    "embree": ("embree_timing", ["-lembree3"], []),
}


def built_peers(folder):
    """By name of a peer, the command of what can be built, and why others are missing."""
    commands, absent = {}, {}
    for name, (source, libraries, first) in PROGRAMS.items():
        program, sources = Path(folder) / source, [HERE / f"{source}.cpp", HERE / "peer_timing.h"]
        if not program.exists() or program.stat().st_mtime < max(path.stat().st_mtime for path in sources):
            program.parent.mkdir(parents=True, exist_ok=True)
            command = ["c++", *FLAGS, str(sources[0]), "-o", str(program), *libraries, "-lpthread"]
            if shutil.which("c++") is None:
                absent[name] = "there is no C++ compiler"
                continue
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                absent[name] = next((line for line in done.stderr.splitlines() if "error" in line), "did not compile")
                continue
        commands[name] = [str(program), *first]
    return commands, absent


def time_peer(command, cage_file, rate, repeats):
    """Seconds of set-up, update, evaluation and all of them, and peak memory in MB; or why it failed."""
    arguments = [*command, str(cage_file), str(rate), str(repeats), "shared"]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    if done.returncode < 0:
        # What asks for more memory than there is, the system kills.
        return {"failed": f"ended by {signal.Signals(-done.returncode).name}"}
    if done.returncode:
        return {"failed": done.stderr.strip() or f"exit status {done.returncode}"}
    return json.loads(done.stdout)
