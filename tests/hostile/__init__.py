"""A hostile suite: damage, bombs, wrong words, signals, full disks and rivals, against the command line of curvafit.

`python -m tests.hostile` runs every case, prints a table by class and ends with exit code 1 if any number in it is not
zero; `--quick` runs a part that is spread over all classes, `--case ID` one case alone, `--package PATH` the package of
another working tree. Cases use the command line and `curvafit.load` only, so that any version can be compared.

A case is judged by rules, not by expected texts:

tracebacks      No exception escapes, no process crashes.
lost            What stood in the folder before has the same bytes after; nothing that a case plants is told to go.
torn            A run that fails or is killed leaves nothing new but what the program documents as kept; nothing ever
                leaves a temporary name; every output of a run that succeeds can be opened by another reader.
misread         A damaged input is not read as other values, shape, spacing or affine without a note or an error. This
                counts only where the format can tell: checksums (gzip, zip, zlib, CRC32C, Fletcher32), sizes that a
                header implies, chunks that are missing. A bit that flips in an uncompressed payload without a
                checksum can be noticed by nobody: it must raise no traceback, and is not counted.
hung            No case takes more than 20 s of processor, nor of waiting, nor 1.5 GiB beyond what the program holds.
wrong           The exit code is 0, 1 or 2 (130 or 143 where a signal came). With 2 the output stream is empty and
                the error stream has one line that starts `error: `; lines before it that start `[` (progress) or
                `note: `, or tell a sample's licence, are allowed. With 0 no output holds a number that is not finite.

Cases are the same on every machine: what is random comes from the seed and the case's name.
"""
