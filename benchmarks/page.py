"""One page with all figures of speed: `make bench`. It runs the benchmarks below, one after another.

Each figure is followed by its ratio to that of the last page of another commit. A benchmark during which other processes took
more than 5 % of the cores is marked as busy. Finished benchmarks are not repeated for the same commit, so an interrupted page
continues where it was. With uncommitted changes everything is measured again.

With --release the figures are also written to releases.csv in this folder, the table of all releases. It names the machine
of each figure, and how busy the machine was with other processes.
"""

import csv
import io
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import tyro

from ballbot_gym import files
from ballbot_train.work.provenance import provenance

_HERE = Path(__file__).parent
_RELEASES = _HERE / "releases.csv"
_BUSY = 0.05  # share of the cores that others took
_MORE_IS_BETTER = {"steps/s", "times"}  # of other units, less is


@dataclass(frozen=True)
class Section:
    """A benchmark of this folder, and which columns of its table are figures."""

    title: str
    script: str
    keys: tuple[str, ...]
    """Columns that name a row."""
    figures: dict[str, str]
    """Columns with figures, and their units."""
    arguments: tuple[str, ...] = ()
    quick: tuple[str, ...] = ()
    """Replaces `arguments` for a quick page."""
    table: str = ""
    """Name of the CSV file, if it is not that of the script."""


SECTIONS = (
    Section("Memory", "memory", ("what",), {"peak_mib": "MiB"}),
    Section(
        "The paper's optimizations",
        "trajopt_vs_drake",
        ("problem", "guess", "program"),
        {"cold_s": "s", "warm_s": "s"},
        quick=("--quick",),
    ),
    Section(
        "Optima one by one",
        "optimum_coverage",
        ("task",),
        {"seconds_median": "s", "seconds_p95": "s"},
        ("--draws", "200", "--exhaustive-episodes", "0", "--workers", "1"),
        ("--draws", "10", "--exhaustive-episodes", "0", "--workers", "1"),
        "coverage",
    ),
    Section(
        "Optima at once",
        "batched_optima",
        ("task",),
        {"milliseconds": "ms", "speedup": "times"},
        quick=("--episodes", "20"),
    ),
    Section(
        "NMPC",
        "mpc_latency",
        ("task", "mode", "nodes", "horizon", "control_dt"),
        {"median_ms": "ms", "p99_ms": "ms"},
        quick=("--quick",),
    ),
    Section(
        "Environments by number",
        "vector_engines",
        ("envs",),
        dict.fromkeys(("native", "torch", "sync"), "steps/s"),
        quick=("--sizes", "1", "64", "1024", "--runs", "1"),
    ),
    Section(
        "Many environments",
        "throughput",
        ("what", "env", "batch", "device"),
        {"steps_per_second": "steps/s", "first_step_seconds": "s"},
        quick=("--seconds", "0.5", "--batches", "1024", "16384"),
    ),
)
"""What the page holds."""


def main(
    out: Path = Path("runs/bench"),
    sections: tuple[str, ...] = (),
    quick: bool = False,
    previous: Path | None = None,
    release: bool = False,
) -> None:
    """Runs the benchmarks, and writes bench.md and its figures.

    Args:
        out: folder of the pages, one folder for each commit.
        sections: names of the scripts to run; default, all.
        quick: shorter runs, which only show that everything works.
        previous: page to compare with; default, the newest of another commit.
        release: write the figures into the table of releases too, under the version of the package.
    """
    known = [section.script for section in SECTIONS]
    if unknown := set(sections) - set(known):
        raise SystemExit(f"no such section: {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    commit = str(provenance()["commit"])
    page = out / (commit + ("-quick" if quick else ""))
    again = commit == "none" or commit.endswith("-dirty")  # then the folder's name does not say what was measured
    records = []
    for section in SECTIONS:
        if not sections or section.script in sections:
            records.append((section, _measured(section, page / section.script, quick, again)))
    if release:
        _record(records, quick)
    before = previous or _newest_other(out, page)
    print(f"written: {files.write(page / 'bench.md', _markdown(page, records, before))}")


def _measured(section: Section, out: Path, quick: bool, again: bool) -> dict[str, Any]:
    """Figures and circumstances of a section, from its folder if it has been run and must not be again."""
    kept = out / "page.json"
    if kept.exists() and not again:
        return files.read_json(kept)
    shutil.rmtree(out, ignore_errors=True)
    arguments = section.quick if quick else section.arguments
    print(f"{section.title}: {section.script}.py {' '.join(arguments)}", flush=True)
    jitter = _jitter()
    before, start = _processor_seconds(), time.monotonic()
    run = subprocess.run(
        [sys.executable, str(_HERE / f"{section.script}.py"), *arguments, "--out", str(out)], check=False
    )
    wall, after = time.monotonic() - start, _processor_seconds()
    figures: dict[str, dict[str, float]] = {}
    table = out / f"{section.table or section.script}.csv"
    if run.returncode == 0:
        with table.open(newline="") as lines:
            figures = _figures(section, list(csv.DictReader(lines)))
    others = max(0.0, (after[0] - before[0]) - (after[1] - before[1])) / (wall * (os.cpu_count() or 1))
    record = {
        "figures": figures,
        "failed": run.returncode != 0,
        "minutes": wall / 60,
        "others": others,
        "jitter": jitter,
    }
    if run.returncode == 0:
        files.write(kept, json.dumps(record, indent=1) + "\n")
    return record


def _record(records: Sequence[tuple[Section, dict[str, Any]]], quick: bool) -> None:
    """Writes the figures into releases.csv; those of the same version and section are replaced."""
    facts = provenance()
    of = {
        "version": facts["version"],
        "machine": f"{facts['machine']}, {_processor()}",
        "python": facts["python"],
        "quick": quick,
    }
    new = [
        of | {"others": round(record["others"], 3), "section": section.script, "row": row, "figure": name}
        | {"value": value, "unit": section.figures[name]}
        for section, record in records
        for row, figures in record["figures"].items()
        for name, value in figures.items()
    ]  # fmt: skip
    again = {(str(row["version"]), row["section"]) for row in new}
    with _RELEASES.open(newline="") if _RELEASES.exists() else io.StringIO() as lines:
        kept = [row for row in csv.DictReader(lines) if (row["version"], row["section"]) not in again]
    files.write_csv(_RELEASES, [*kept, *new])
    print(f"written: {_RELEASES}")


def _figures(section: Section, rows: Sequence[dict[str, str]]) -> dict[str, dict[str, float]]:
    """Figures by row and column; those that a row has not are left out."""
    return {
        ", ".join(_short(row[key]) for key in section.keys): {
            name: float(row[name]) for name in section.figures if np.isfinite(float(row[name] or "nan"))
        }
        for row in rows
    }


def _short(text: str) -> str:
    """Without the digits of a float that say nothing."""
    try:
        return f"{float(text):g}"
    except ValueError:
        return text


def _processor_seconds() -> tuple[float, float]:
    """Seconds in which cores worked for any process, and seconds in which they worked for the children of this process.

    Without /proc the first is not known. Then both are the same, and no benchmark is marked as busy.
    """
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    own = usage.ru_utime + usage.ru_stime
    try:
        user, nice, system, _, _, irq, softirq, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    except OSError:
        return own, own
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK"), own


def _processor() -> str:
    """The processor's name, as Linux gives it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor()
    )


def _jitter() -> float:
    """By how much the slowest tenth of equal loops exceeds their median, relative: the machine's noise."""
    times = []
    for _ in range(50):
        start = time.perf_counter()
        sum(i * i for i in range(100_000))
        times.append(time.perf_counter() - start)
    return float(np.percentile(times, 90)) / median(times) - 1


def _newest_other(out: Path, page: Path) -> Path | None:
    """The page that was written last, of another commit and of the same length."""
    quick = page.name.endswith("-quick")
    others = [p for p in out.glob("*/bench.md") if p.parent != page and p.parent.name.endswith("-quick") == quick]
    return max(others, key=lambda path: path.stat().st_mtime, default=None)


def _markdown(page: Path, records: Sequence[tuple[Section, dict[str, Any]]], before: Path | None) -> str:
    facts = provenance()
    lines = ["# Speed of this machine", ""]
    lines += [f"Commit {page.name}, {facts['machine']}, Python {facts['python']}."]
    lines += [
        f"Ratios are to {before.parent.name}; above 1 is better." if before else "There is no page to compare with."
    ]
    lines += [
        "*Noise* is how much longer the slowest tenth of equal short loops took than their median, before a benchmark began. "
        f"*Others* is the share of the cores that other processes took meanwhile; above {_BUSY:.0%} a section is busy.",
    ]
    for section, record in records:
        busy = " (busy machine)" if record["others"] > _BUSY else ""
        lines += ["", f"## {section.title}{busy}", ""]
        lines += [
            f"`benchmarks/{section.script}.py`, {record['minutes']:.1f} min, noise {record['jitter']:.0%}, "
            f"others {record['others']:.0%}."
        ]
        if record["failed"]:
            lines += ["", "It failed; see what it printed."]
            continue
        kept = before.parent / section.script / "page.json" if before else None
        old = files.read_json(kept)["figures"] if kept is not None and kept.exists() else {}
        names = list(section.figures)
        lines += ["", f"| {', '.join(section.keys)} | {' | '.join(f'{n} | ratio' for n in names)} |"]
        lines += ["|" + "---|" * (1 + 2 * len(names))]
        for row, figures in record["figures"].items():
            cells = []
            for name, unit in section.figures.items():
                value, earlier = figures.get(name), old.get(row, {}).get(name)
                cells += ["–" if value is None else f"{_rounded(value)} {unit}", _ratio(value, earlier, unit)]
            lines += [f"| {row} | {' | '.join(cells)} |"]
        picture = f"{section.script}/{section.script}.png"
        if (page / picture).exists():
            lines += ["", f"![{section.title}]({picture})"]
    return "\n".join(lines) + "\n"


def _rounded(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _ratio(value: float | None, earlier: float | None, unit: str) -> str:
    if not value or not earlier:
        return "–"
    return f"{value / earlier if unit in _MORE_IS_BETTER else earlier / value:.2f}"


if __name__ == "__main__":
    tyro.cli(main)
