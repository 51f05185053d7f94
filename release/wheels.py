"""Builds what is published: the source, a wheel for every machine, and one with compiled code for machines like this one.

    python release/wheels.py CODE DIST   from the code that generated.py wrote

Both wheels contain the C code of the vector environments of all shipped robots and tasks, so that these need no CasADi. The
wheel for this machine also contains the libraries that environments, optima and experts compile otherwise, for every level
of processors: who installs it needs no compiler.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import generated

from ballbot_gym import machine_code

ROOT = Path(__file__).parent.parent
LEVEL_FLAGS = {"x86-64-v3": ("-march=x86-64-v3",), "x86-64": ("-march=x86-64",), "arm64": ()}
"""The flags of each of `machine_code.LEVELS`."""

_MACOS = "11.0"
"""The oldest macOS on which compiled code is to run."""


def levels() -> tuple[str, ...]:
    """The levels of this machine's family."""
    family = "arm64" if platform.machine().lower() in ("arm64", "aarch64") else "x86-64"
    return tuple(level for level in machine_code.LEVELS if level.startswith(family))


def compile_all(codes: list[machine_code.Code], folder: Path) -> None:
    """Compiles all code for every level of this machine's family, unless a library of it is there already."""
    program = machine_code.compiler()
    if program is None:
        sys.exit("there is no C compiler: install one, or set CC")
    os.environ.setdefault("MACOSX_DEPLOYMENT_TARGET", _MACOS)
    for level in levels():
        (folder / level).mkdir(parents=True, exist_ok=True)
        made = {path.stem.rpartition("-")[0]: path for path in (folder / level).glob(f"*{machine_code.SUFFIX}")}
        for code in codes:
            if code.stem() not in made:
                code.build(program, folder / level, code.stem(), LEVEL_FLAGS[level])
        for stem in made.keys() - {code.stem() for code in codes}:
            made[stem].unlink()
        print(f"{level}: {len(codes)} libraries", flush=True)


def platform_tag(folder: Path) -> str:
    """The tag of a wheel with these libraries: any Python 3 on this system, on Linux with the C library that they need."""
    system = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    if system.startswith("linux_"):
        needs = [
            (int(major), int(minor))
            for path in folder.rglob(f"*{machine_code.SUFFIX}")
            for major, minor in re.findall(rb"GLIBC_(\d+)\.(\d+)", path.read_bytes())
        ]
        major, minor = max(needs, default=(2, 17))
        system = system.replace("linux", f"manylinux_{major}_{minor}", 1)
    if system.startswith("macosx_"):
        system = f"macosx_{_MACOS.replace('.', '_')}_{platform.machine()}"
    return f"py3-none-{system}"


def build(kind: str, out: Path, compiled: Path, tag: str = "") -> None:
    """Builds the "sdist", or a "wheel" that contains the folder `compiled`."""
    environment = {**os.environ, "BALLBOT_COMPILED": str(compiled), "BALLBOT_TAG": tag}
    subprocess.run(
        [sys.executable, "-m", "build", f"--{kind}", "--outdir", str(out), str(ROOT)], env=environment, check=True
    )


def main() -> None:
    """Builds all three."""
    code, out = Path(sys.argv[1]), Path(sys.argv[2])
    shutil.rmtree(out, ignore_errors=True)
    libraries = code.resolve() / "compiled"
    compile_all(generated.read(code), libraries)
    with tempfile.TemporaryDirectory() as scratch:
        content = Path(scratch) / "compiled"
        shutil.copytree(code / "source", content / "source")
        build("sdist", out, content)
        build("wheel", out, content)
        shutil.copytree(libraries, content, dirs_exist_ok=True)
        build("wheel", out, content, platform_tag(content))
    for path in sorted(out.iterdir()):
        print(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
