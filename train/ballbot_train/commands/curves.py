"""`ballbot curves RUN ...`: learning curves over seeds, against env steps and against minutes."""

from pathlib import Path

from ballbot_train.console import console, print_table


def curves(runs: tuple[Path, ...], /, out: Path = Path("runs/curves")) -> None:
    """Draws learning curves of the regret: interquartile mean over seeds with bootstrap bands, one line per learner.

    Args:
        runs: folders of `ballbot train`, or folders of such folders, as of several seeds.
        out: folder of curves.png, of curves.csv with every point, and of curves.md with where each curve ends.
    """
    from ballbot_train.report import curves as report  # it imports matplotlib

    if not runs:
        raise ValueError("give at least one folder of ballbot train")
    drawn = report.grouped(report.read_runs(runs))
    picture = report.write(drawn, out)
    print_table("where the curves end", *report.summary(drawn))
    console.print(f"figure: {picture}\npoints: {out / 'curves.csv'}\ntable: {out / 'curves.md'}")
