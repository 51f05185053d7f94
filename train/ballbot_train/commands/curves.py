"""`ballbot curves RUN ...`: learning curves over seeds, against env steps and against minutes."""

from pathlib import Path

from ballbot_gym import files
from ballbot_train.console import console, print_rows


def curves(runs: tuple[Path, ...], /, out: Path = Path("runs/curves")) -> None:
    """Draws learning curves of the regret: interquartile mean over seeds with bootstrap bands, one line per learner.

    Args:
        runs: folders of `ballbot train`, or folders of such folders, as of several seeds.
        out: folder of curves.png, and of curves.csv with where each curve ends.
    """
    from ballbot_train.report import curves as report  # it imports matplotlib
    from ballbot_train.report.figures import save

    if not runs:
        raise ValueError("give at least one folder of ballbot train")
    drawn = report.read_curves(runs)
    picture, rows = save(report.figure(drawn), out / "curves.png"), report.summary(drawn)
    print_rows("where the curves end", rows)
    console.print(f"figure: {picture}\ntable: {files.write_csv(out / 'curves.csv', rows)}")
