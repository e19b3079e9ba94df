"""A process in which the libraries are loaded, and which forks one for each command that a test breaks off or bounds.

It reads a line of JSON with commands from its input, and answers with a line of what came of each. A command has a
folder and words, and may have: `change` and `signal`, the change of a file in the folder at which it gets that signal;
`lag`, seconds that each change lasts at most; `file` and `memory`, the bytes that a file, or all it maps, may grow to.
"""

from __future__ import annotations

import importlib
import json
import os
import random
import resource
import sys
import time
import traceback
from pathlib import Path
from typing import Any

LIBRARIES = (
    "numba nibabel h5py tifffile matplotlib.backends.backend_agg skimage.filters scipy.ndimage kornia distributed "
    "curvafit.cli.app curvafit.core.workers curvafit.generation.flow curvafit.segmentation.segment "
    "curvafit.data_synth.atlas curvafit.data_synth.sets curvafit.drawing.shapes"
)
CHANGES = ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.link", "os.symlink")


def main() -> None:
    """Answer until the input ends."""
    for name in LIBRARIES.split():
        importlib.import_module(name)
    for line in sys.stdin:
        running = [_start(**command) for command in json.loads(line)]
        print(json.dumps([_finish(*each) for each in running]), flush=True)


def _start(**command: Any) -> tuple[int, int]:
    said, saying = os.pipe()
    if pid := os.fork():
        os.close(saying)
        return pid, said
    for stream in (1, 2):
        os.dup2(saying, stream)
    code = 70
    try:
        code = _run(**command)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _finish(pid: int, said: int) -> dict[str, Any]:
    with os.fdopen(said, encoding="utf-8", errors="replace") as stream:
        text = stream.read()
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    changes = [int(line.split()[1]) for line in text.splitlines() if line.startswith("changes ")]
    return {"code": code, "said": text, "changes": changes[-1] if changes else 0}


def _run(folder: str, words: list[str], file: int = 0, memory: int = 0, **how: Any) -> int:
    os.chdir(folder)
    sys.argv = ["curvafit", *words]
    from curvafit.__main__ import main as run

    count = _watch(folder, **how)
    if file:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file, file))
    if memory:
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (mapped + memory, mapped + memory))
    try:
        run()
    except SystemExit as leave:
        return leave.code if isinstance(leave.code, int) else int(leave.code is not None)
    finally:
        print(f"changes {count()}")
    return 0


def _watch(folder: str, change: int = 0, signal: int = 0, lag: float = 0.0) -> Any:
    """Count what happens to files in the folder, and do at each what was asked for."""
    done = 0

    def hook(event: str, arguments: tuple) -> None:
        nonlocal done
        opened = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if not (opened or event in CHANGES) or isinstance(arguments[0], int):
            return
        name = os.fsdecode(arguments[0])
        if os.path.isabs(name) and not name.startswith(folder):
            return
        done += 1
        if done == change:
            os.kill(os.getpid(), signal)
        time.sleep(lag * random.random())

    sys.addaudithook(hook)
    return lambda: done


if __name__ == "__main__":
    main()
