"""100,000 damaged inputs for all that scanmap reads: no crash, no hang; how long did the slowest take?

    python benchmarks/fuzzing.py [--inputs 100000] [--seed 1] [TARGET ...]

A plain seeded loop over the targets of tests/fuzz_targets.py; tests/test_fuzz.py searches the same ones more cleverly
and many times slower. An input that fails is written to fuzz-failure.bin; exit code 1.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from fuzz_targets import TARGETS, Target

HANG_S = 60
WORDS = (
    b"nan",
    b"-inf",
    b"1e999",
    b"-1",
    b"0",
    b"99999999999999999999",
    b'"',
    b"[",
    b"]",
    b"=",
    b"\n",
    b",",
    b"\xff\xfe",
)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """One to six of: bits flipped, bytes gone, doubled, overwritten, a telling word put in; at times pure noise."""
    if rng.random() < 0.05:
        return rng.bytes(int(rng.integers(0, 400)))
    for _ in range(rng.integers(1, 7)):
        at = int(rng.integers(0, len(data) + 1))
        size = int(rng.choice((1, 1, 2, 4, 8, 64)))
        kind = rng.integers(6)
        if kind == 0 and at < len(data):
            data = data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :]
        elif kind == 1:
            data = data[:at] + data[at + size :]
        elif kind == 2:
            data = data[:at] + data[at : at + size] + data[at:]
        elif kind == 3:
            data = data[:at] + rng.bytes(size) + data[at + size :]
        elif kind == 4:
            data = data[:at] + WORDS[int(rng.integers(len(WORDS)))] + data[at + size * int(rng.integers(2)) :]
        elif rng.random() < 0.2:
            data = data[:at]
    return data


def hung(*_: object) -> None:
    raise TimeoutError(f"still busy after {HANG_S} s")


def campaign(target: Target, count: int, rng: np.random.Generator, folder: Path) -> tuple[int, float]:
    """Inputs that failed, and the longest time one took [s of CPU]."""
    failed, slowest = 0, 0.0
    for _ in range(count):
        data = mutated(target.good, rng)
        begun = time.process_time()
        signal.alarm(HANG_S)
        try:
            target.read(data, folder)
        except Exception:
            traceback.print_exc()
            Path("fuzz-failure.bin").write_bytes(data)
            failed += 1
        signal.alarm(0)
        slowest = max(slowest, time.process_time() - begun)
    return failed, slowest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=", ".join(TARGETS))
    parser.add_argument("--inputs", type=int, default=100_000, help="in all")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    signal.signal(signal.SIGALRM, hung)
    names = options.targets or list(TARGETS)
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        for number, name in enumerate(names):
            count = options.inputs * (number + 1) // len(names) - options.inputs * number // len(names)
            rng = np.random.default_rng([options.seed, *name.encode()])
            failed, slowest = campaign(TARGETS[name], count, rng, Path(folder))
            bad += failed
            print(f"{name}: {count} inputs, {failed} failed, slowest {slowest * 1e3:.0f} ms", flush=True)
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
