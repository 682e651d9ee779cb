"""`python -m benchmarks`: run all benchmarks or those named, print their tables, write them where asked."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

NAMES = ("retroreflection", "growth", "lenses", "features", "detection", "tracking", "filming", "synth")
NAMES += ("live", "playground", "learning", "training", "inference", "gpu")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; 0 when all ran, 2 for a name that is none or a document without markers."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which ones: {', '.join(NAMES)}; all by default")
    parser.add_argument("--write", action="store_true", help="put the tables into docs/performance.md")
    parser.add_argument("--quick", action="store_true", help="one round of little work: to see that they run")
    parser.add_argument("--rounds", type=int, default=7, help="how often ours and the peer take turns")
    options = parser.parse_args(arguments)
    if unknown := [name for name in options.names if name not in NAMES]:
        parser.error(f"no benchmark {', '.join(unknown)}; there are: {', '.join(NAMES)}")
    if options.rounds < 1:
        parser.error("--rounds must be at least 1")
    if options.quick and options.write:
        parser.error("--quick measures nothing worth writing down; leave out one of the two")

    # Commands own their process and do this, so a benchmark of what commands do does it as well: before any tensor.
    from tapetum.memory import keep_big_blocks

    keep_big_blocks()
    from .measure import Effort, machine
    from .table import show, write

    effort = Effort(1 if options.quick else options.rounds, options.quick)
    for name in options.names or NAMES:
        benchmark = importlib.import_module(f".{name}", __package__)
        print(f"{name}: {benchmark.TITLE} …", file=sys.stderr, flush=True)
        rows, where = benchmark.run(effort), machine(*benchmark.PEERS)
        if not rows:
            print(f"{name}: needs a GPU, and there is none", file=sys.stderr)
            continue
        show(benchmark.TITLE, rows, where)
        if options.write:
            write(name, rows, where)
    return 0


if __name__ == "__main__":
    sys.exit(main())
