"""`ballbot submit`: the motions of a controller in the certified episodes, as files for the leaderboard."""

from pathlib import Path

from ballbot_gym import files
from ballbot_train.commands.verify import print_entries
from ballbot_train.evaluation import submissions
from ballbot_train.work.console import console


def submit(
    results: Path, /, *, name: str, link: str = "", controller: str = "", out: Path = Path("submissions")
) -> None:
    """Packs recorded motions of a folder of results as submissions to the leaderboard, one file per task, and verifies them.

    Args:
        results: folder that evaluate(out=...) or `ballbot benchmark` wrote.
        name: name of the row in the leaderboard.
        link: address of a page about the controller; it begins with https://.
        controller: name of the controller, if the folder has several.
        out: folder of the submissions.
    """
    packed = submissions.pack(results, name, link, controller)
    # all are verified before one is written, so that a refused one replaces nothing
    entries = [submissions.verify(out / file, content=content) for file, content in packed.items()]
    for file, content in packed.items():
        if (out / file).exists() and files.read(out / file) != content:
            raise submissions.SubmissionError(
                f"{out / file} is another submission of this name; submit under another --name, give another --out, or "
                "delete that file"
            )
    paths = [files.write(out / file, content) for file, content in packed.items()]
    print_entries(entries)
    for path in paths:
        console.print(f"submission: {path}, {path.stat().st_size / 2**20:.2f} MiB")
