# SPDX-License-Identifier: Apache-2.0
"""Whether anything that others give the suite ends in something else than a sentence.

    python -m benchmarks.fuzz [--inputs N] [--seed S] [--only bags,maps,…]

Alters sound files (bags and what is in them, maps, clouds, images and intrinsics, YAML, JSON, archives of samples,
networks, robots, poses), and sends hostile messages, requests, goals and parameters to all nodes of the graph in one
process. Each input has to be accepted or refused with an OpenArmError of one sentence. Exit code 1 at a raw error, a
hang, a process that died, or an input that needs more than 512 MiB.

    raw      errors of any other type, a node that ended or was silent for 2 s, texts of more than 4000 characters
    hangs    inputs that took longer than 20 s
    time     of the worst input, s
    memory   that the worst input needed beyond what was there before, MiB
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context

from benchmarks.fuzz.files import KINDS, read_altered
from benchmarks.fuzz.graph import send_hostile
from benchmarks.fuzz.judge import Tally

#: Share of all inputs, by kind.
SHARES = {
    "bags": 12, "contents": 2, "maps": 12, "clouds": 8, "pictures": 6, "yaml": 20, "json": 6, "npz": 8, "onnx": 4,
    "robots": 8, "poses": 8, "messages": 16, "requests": 6, "goals": 3, "parameters": 3,
}  # fmt: skip


def in_a_process(kind: str, count: int, seed: int) -> list[Tally]:
    """Do a kind in a process of its own, whose death is an error too."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        try:
            if kind in KINDS:
                return [pool.submit(read_altered, kind, count, seed).result()]
            return pool.submit(send_hostile, {kind: count}, seed).result()
        except BrokenProcessPool:
            tally = Tally(kind, inputs=count)
            tally.raw["the process died"] += 1
            return [tally]


def print_table(tallies: Sequence[Tally]) -> None:
    """One line for each kind."""
    columns = ("inputs", "accepted", "refused", "raw", "hangs", "time", "memory")
    print(f"{'kind':12s}" + "".join(f"{name:>9s}" for name in columns))
    for t in tallies:
        counts = "".join(f"{n:9d}" for n in (t.inputs, t.accepted, t.refused, t.raw.total(), t.hangs))
        print(f"{t.kind:12s}{counts}{t.worst_s:9.2f}{t.worst_mib:9.1f}")
    for t in tallies:
        for note in t.notes:
            print(f"{t.kind}: {note}")
        for text, count in t.raw.most_common():
            print(f"{t.kind}: {count} × {text}")


def main() -> None:
    """Run the kinds that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10_000, help="in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(SHARES), help="kinds, separated by commas")
    options = parser.parse_args()
    kinds = options.only.split(",")
    if unknown := [kind for kind in kinds if kind not in SHARES]:
        parser.error(f"no kind {unknown[0]!r}; kinds: {', '.join(SHARES)}")
    total = sum(SHARES[kind] for kind in kinds)
    counts = {kind: max(1, options.inputs * SHARES[kind] // total) for kind in kinds}
    tallies: list[Tally] = []
    for kind, count in counts.items():
        tallies += in_a_process(kind, count, options.seed)
        print(f"{kind}: {count} done", file=sys.stderr)
    print_table(tallies)
    sys.exit(not all(t.sound for t in tallies))


if __name__ == "__main__":
    main()
