"""`ballbot curves RUN ...`: learning curves over seeds, against env steps and against minutes."""

from pathlib import Path

from ballbot_train.console import check_names, console, print_table


def curves(runs: tuple[Path, ...], /, metric: str = "regret", out: Path = Path("runs/curves")) -> None:
    """Draws learning curves: interquartile mean over seeds with bootstrap bands, one line per learner.

    Args:
        runs: folders of `ballbot train`, or folders of such folders, as of several seeds.
        metric: regret, in which an episode without success counts as failing at once; regret_mean, regret_median or
            regret_worst of what did not fail; success; failures; validation_cost; or validation_mean_cost.
        out: folder of curves.png, of curves.csv with every point, and of curves.md with where each curve ends.
    """
    from ballbot_train.report import curves as report  # it imports matplotlib

    check_names("metric", [metric], report.METRICS)
    if not runs:
        raise ValueError("give at least one folder of ballbot train")
    drawn = report.grouped(report.read_runs(runs))
    picture = report.write(drawn, metric, out)
    print_table("where the curves end", *report.summary(drawn, metric))
    console.print(f"figure: {picture}\npoints: {out / 'curves.csv'}\ntable: {out / 'curves.md'}")
