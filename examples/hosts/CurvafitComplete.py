"""3D Slicer's module "Complete slices (curvafit)": hand volumes to the program `curvafit`, and its progress to Slicer.

Slicer's own Python runs this, which needs no package; curvafit is installed in an environment of its own.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile

#: What Slicer sets for its own Python and libraries, which would mislead another.
OWN = ("PYTHON", "LD_LIBRARY_PATH", "DYLD_", "QT_")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("labels")
    parser.add_argument("filled")
    for name in ("--image", "--probability"):
        parser.add_argument(name)
    parser.add_argument("--every", type=int, default=0)
    parser.add_argument("--axis", default="z")
    parser.add_argument("--several", action="store_true")
    parser.add_argument("--program", default="curvafit")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        out = os.path.join(folder, "filled.nii.gz")
        command = [options.program, "reconstruct", options.labels, "-o", out, "--axis", options.axis]
        command += ["--every", str(options.every)] if options.every else []
        command += ["--labels", "all"] if options.several else []
        command += ["--image", options.image] if options.image else []
        environment = {name: value for name, value in os.environ.items() if not name.startswith(OWN)}
        try:
            work = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, encoding="utf-8")
        except OSError as error:
            return f"cannot run {options.program}: {error.strerror}; choose the curvafit program"
        for line in work.stderr or ():
            if step := re.match(r"\[ *(\d+) %\] (.*)", line):
                print(f"<filter-progress>{int(step[1]) / 100}</filter-progress>", flush=True)
                print(f"<filter-comment>{step[2]}</filter-comment>", flush=True)
            else:
                print(line, end="", file=sys.stderr)
        if work.wait():
            return work.returncode
        shutil.move(out, options.filled)
        if options.probability:
            shutil.move(os.path.join(folder, "filled_probability.nii.gz"), options.probability)
    return 0


if __name__ == "__main__":
    sys.exit(main())
