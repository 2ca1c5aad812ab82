"""Fuzz the readers: `python tests/fuzz.py [N]` mutates decks N times (10,000) and checks each as `mpitled check` does.

Each has to end in a mesh or in one line of an InputError, within 5 s and 2 GiB, and leave no file behind.
"""

from __future__ import annotations

import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

from decks import KINDS, void_decks

from mpitled.errors import InputError
from mpitled.speed import overview

LIMIT_S, LIMIT_BYTES = 5, 2 << 30
_NASTY = [
    "", "-", "1e", "1e999", "-1e308", "nan", "inf", "0x10", "1_0", "1.0-3", "1.0D+2", "999999999999999999", "1e18",
    "-5", "0", "2147483648", "9" * 400, "1.5", '"', ",", "*", "**", "$", "&x", "\t", "\x00", "é", "  ", "1 2", "+",
]  # fmt: skip


def mutated(text: str, rng: random.Random) -> bytes:
    """One to six changes: bytes dropped or changed, lines swapped, dropped or doubled, numbers broken, ends cut off."""
    data = text.encode()
    for _ in range(rng.choice([1, 1, 1, 2, 3, 6])):
        lines = data.split(b"\n")
        kind = rng.randrange(9)
        at = rng.randrange(len(data)) if data else 0
        i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
        if kind == 0:
            data = data[:at] + data[at + rng.randint(1, 12) :]
        elif kind == 1 and data:
            data = data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
        elif kind == 2:
            lines[i], lines[j] = lines[j], lines[i]
            data = b"\n".join(lines)
        elif kind == 3:
            data = b"\n".join(lines[:i] + lines[i + 1 :])
        elif kind == 4:
            data = b"\n".join([*lines[:i], lines[j], *lines[i:]])
        elif kind in (5, 6):
            found = list(re.finditer(rb"[\w.+-]+", data))
            if found:
                word = rng.choice(found)
                data = data[: word.start()] + rng.choice(_NASTY).encode() + data[word.end() :]
        elif kind == 7:
            data = data[:at]
        else:
            data = data.replace(b"\n", rng.choice([b"\r\n", b"\r", b"\n\n", b",\n"]), rng.randint(1, 20))
    return data


def fuzz(n: int, first: int = 0) -> Counter[str]:
    """How many ended how; prints what must not be and counts it as "broken"."""
    signal.signal(signal.SIGALRM, _too_long)
    warnings.simplefilter("error")
    kinds = {**KINDS, "mixed": {"scene.toml": void_decks()["scene.toml"], **void_decks()}}
    names = list(kinds)
    ends: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(first, first + n):
            rng = random.Random(seed)
            # The mixed mesh takes longest, and has decks of its own.
            name = rng.choice(names[:-1]) if rng.random() > 0.1 else names[-1]
            files = kinds[name]
            victim = rng.choice(list(files))
            written = set()
            for file, text in files.items():
                path = Path(folder, file)
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(mutated(text, rng) if file == victim else text.encode())
                written.add(path)
            broken = ""
            try:
                signal.alarm(LIMIT_S)
                overview.check(Path(folder, next(iter(files))))
                ends["mesh"] += 1
            except InputError as error:
                ends["error"] += 1
                if "\n" in str(error) or not str(error):
                    broken = f"a message that is not one line: {error!r}"
            except (Exception, SystemExit):
                broken = traceback.format_exc()
            finally:
                signal.alarm(0)
            if extra := {path for path in Path(folder).rglob("*") if path.is_file()} - written:
                broken += f"left {extra}"
            if broken:
                ends["broken"] += 1
                print(f"seed {seed} ({name}, {victim}): {broken}", file=sys.stderr)
            for path in Path(folder).rglob("*"):
                if path.is_file():
                    path.unlink()
    return ends


def _too_long(*_: object) -> None:
    raise TimeoutError(f"took more than {LIMIT_S} s")


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_DATA, (LIMIT_BYTES, LIMIT_BYTES))
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    begin = time.perf_counter()
    result = fuzz(count, int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    print(f"{count} decks in {time.perf_counter() - begin:.0f} s: " + ", ".join(f"{k} {v}" for k, v in result.items()))
    sys.exit(bool(result["broken"]))
