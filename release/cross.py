"""Compiles all generated C code for every system and processor, without a warning, and runs that of ARM in an emulator.

    python release/cross.py CODE   from the code that generated.py wrote

The compilers are those of the package `ziglang`. The emulator is `qemu-aarch64`; where it is not installed, nothing is run.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import generated
import numpy as np

from ballbot_gym import machine_code

TARGETS = (
    *("x86_64-linux-gnu", "aarch64-linux-gnu", "x86_64-linux-musl"),
    *("x86_64-macos", "aarch64-macos", "x86_64-windows-gnu", "aarch64-windows-gnu"),
)
_WARNINGS = ("-Wall", "-Wextra", "-Werror")
_EXPECTED = (
    *("-Wno-unused-parameter", "-Wno-unused-function", "-Wno-unused-variable", "-Wno-unused-but-set-variable"),
    "-Wno-pass-failed",
)
"""What generated code may do: compute what nothing reads, and loop without SIMD where the C library has no such sines."""
_ROBOTS = 37  # two whole blocks of lanes, and a part of one

ROLLOUT = """
#include <stdio.h>
#include <stdlib.h>
enum { B = %d };
int main(void) {
    static real x[2][STATES * B], c[2][AT_LEAST_1(CONSTANTS) * B], action[ACTIONS * B];
    static real end[ROWS * B], now[FORCE * B], seen[SEEN * B];
    static double pay[PAYS * B];
    static uint8_t flags[FLAGS * B];
    static int64_t which[B], seed[B], episode[2][B], counts[3 * B], steps[B];
    for (int k = 0; k < B; ++k)
        which[k] = seed[k] = k;
    ballbot_start(B, B, which, seed, episode[0], 0, x[0], c[0]);
    for (int n = 0; n < 30; ++n) {
        for (int i = 0; i < ACTIONS * B; ++i)
            action[i] = (real)0.5 * real_sin((real)(n + 0.1 * i));
        Memory m = {.B = B, .most = 10, .episode_steps = 400, .env = 1, .component = B, .x = x[0], .c = c[0],
                    .action = action, .steps = steps, .episode = episode[0], .seed = seed, .restarts = 1, .end = end,
                    .now = now, .seen = seen, .new_c = c[1], .pay = pay, .flags = flags, .counts = counts};
        step(&m);
        memcpy(x[0], now, sizeof x[0]);
        memcpy(c[0], c[1], sizeof c[0]);
        memcpy(steps, counts + B, sizeof steps);
        memcpy(episode[0], counts + 2 * B, sizeof steps);
        if (n %% 5 == 0)
            for (int i = 0; i < STATES * B; ++i)
                printf("%%.9g ", (double)x[0][i]);
    }
    return 0;
}
"""
"""Runs a batch for a while, over several episodes, and prints its states."""


def zig(*arguments: str) -> None:
    """Runs zig's C compiler. Raises a SystemExit with what it says if it says anything."""
    done = subprocess.run(
        [sys.executable, "-m", "ziglang", "cc", *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode != 0 or done.stderr.strip():
        sys.exit(f"zig cc {' '.join(arguments)}\n{done.stderr[-3000:]}")


def compile_for(target: str, codes: list[machine_code.Code], folder: Path) -> None:
    """Compiles all code to shared libraries for a target."""
    suffix = ".dll" if "windows" in target else ".so"
    position = [] if "windows" in target else ["-fPIC"]
    for code in codes:
        path = folder / f"{code.stem()}.c"
        path.write_text(code.source, encoding="utf-8")
        flags = [flag for flag in code.portable_flags if not flag.startswith("-O")]
        built = ["-c", "-o", str(folder / f"{code.stem()}.o")]
        if code is codes[0]:  # one is linked: the others have no other undefined names
            built = ["-shared", *([] if "windows" in target else ["-lm"]), "-o", str(folder / f"{code.stem()}{suffix}")]
        zig("-target", target, "-O1", *flags, *_WARNINGS, *_EXPECTED, *position, str(path), *built)
    print(f"{target}: {len(codes)} libraries without a warning", flush=True)


def states(source: Path, target: str, emulator: tuple[str, ...]) -> np.ndarray:
    """What `ROLLOUT` prints where it is compiled for a target."""
    program = source.with_suffix(f".{target}")
    text = source.read_text(encoding="utf-8") + ROLLOUT % _ROBOTS
    main = source.with_name(f"{source.stem}-main.c")
    main.write_text(text, encoding="utf-8")
    flags = ("-O1", "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fopenmp-simd")
    zig("-target", target, *flags, *_EXPECTED, "-static", str(main), "-o", str(program))
    done = subprocess.run([*emulator, str(program)], capture_output=True, text=True, check=True)
    return np.array(done.stdout.split(), float)


def emulate(folder: Path, scratch: Path) -> None:
    """Compares motions of batches on ARM with those here; float32 differs by rounding, which an unstable robot multiplies."""
    emulator = shutil.which("qemu-aarch64")
    if emulator is None:
        print("qemu-aarch64 is not installed: the code for ARM was not run")
        return
    sources = sorted(path for path in (folder / "source").glob("*.c") if not path.stem.startswith("one-"))
    for source in sources:
        copied = scratch / source.name
        shutil.copy(source, copied)
        here = states(copied, "x86_64-linux-musl", ())
        there = states(copied, "aarch64-linux-musl", (emulator,))
        tolerance = 1e-9 if source.stem.endswith("double") else 1e-2
        np.testing.assert_allclose(there, here, rtol=tolerance, atol=tolerance, err_msg=source.name)
    print(f"aarch64 in an emulator: {len(sources)} robots and tasks move as here", flush=True)


def main() -> None:
    """Compiles for all targets, and emulates."""
    folder = Path(sys.argv[1])
    codes = generated.read(folder)
    with tempfile.TemporaryDirectory() as scratch:
        emulate(folder, Path(scratch))
        for target in TARGETS:
            compile_for(target, codes, Path(scratch))


if __name__ == "__main__":
    main()
