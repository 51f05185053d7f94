"""Checks that a submission backs every row of the leaderboard. It lies in the folder of the row, or in a release.

`released.txt` in the same folder has a line for each row whose submission moved to a release: the digest of the row's content
and the name of its file. This reveals a row that was edited, added or removed by hand.
"""

import hashlib
from dataclasses import asdict
from pathlib import Path

from ballbot_gym import certified, files
from ballbot_gym.tasks.identity import digest
from ballbot_train.evaluation.submissions import LEADERBOARD, Entry, read_entries, verify

LIST = "released.txt"
_VERIFIED = (
    "benchmark",
    "name",
    "link",
    "task",
    "robot",
    "physics",
    "policy",
    "submission",
    "versions",
    "costs",
    "ends",
    "steered",
    "optima",
)


def digest_of(entry: Entry) -> str:
    """Digest of what was verified of a row, of its submission and of what it says about itself."""
    row = asdict(entry)
    return digest([row[name] for name in _VERIFIED])


def _read_released(folder: Path = LEADERBOARD) -> dict[str, str]:
    """The digests of the rows whose submissions are in releases, by the names of the rows' files."""
    path, listed = folder / LIST, {}
    for line in files.read(path).decode().splitlines() if path.exists() else ():
        of, _, file = line.partition("  ")
        if not file or file in listed:
            raise files.FileError(
                f"{path}: each line must be a digest, two spaces and the name of one row's file, not {line!r}"
            )
        listed[file] = of
    return listed


def unbacked(
    folder: Path = LEADERBOARD, episodes: int = certified.EPISODES, downloaded: Path | None = None
) -> list[str]:
    """What is wrong with a leaderboard's rows, one sentence each; empty where every row is backed.

    A submission in the folder of its row is verified again, which takes seconds.

    Args:
        folder: of the rows.
        episodes: of each row.
        downloaded: folder with the submissions of releases. If it is given, the list of released rows decides nothing: each
            row needs its submission, whose SHA-256 the row holds, and it is verified again.
    """
    entries, released = read_entries(folder), _read_released(folder)
    found_in = {} if downloaded is None else {_sha256(path): path for path in sorted(downloaded.rglob("*.npz"))}
    found = {path.name for path in folder.glob("*.json")}
    wrong = [f"{name}: the row is missing, and {LIST} has it" for name in released.keys() - found]
    wrong += [
        f"{path.name}: this submission has no row; run ballbot verify {path.name} --write {folder.name}"
        for path in folder.glob("*.npz")
        if path.with_suffix(".json").name not in found
    ]
    for entry in entries:
        submission = (folder / entry.file).with_suffix(".npz")
        submission = submission if submission.exists() else found_in.get(entry.submission)
        if why := _unbacked(entry, submission, released if downloaded is None else {}, episodes):
            wrong.append(f"{entry.file}: {why}")
    misnamed = found - {entry.file for entry in entries}
    return wrong + [f"{name}: the name of the file is not that of its row" for name in sorted(misnamed)]


def release(folder: Path = LEADERBOARD, episodes: int = certified.EPISODES) -> Path:
    """Lists every row that is backed, before the submissions next to them move to a release.

    Raises:
        ValueError: a row is edited or added by hand.
    """
    wrong = unbacked(folder, episodes)
    present = {path.name for path in folder.glob("*.json")}
    if wrong := [line for line in wrong if line.split(":", maxsplit=1)[0] in present]:
        raise ValueError("\n".join(wrong))
    listed = {entry.file: digest_of(entry) for entry in read_entries(folder)}
    return files.write(folder / LIST, "".join(f"{of}  {file}\n" for file, of in sorted(listed.items())))


def _sha256(path: Path) -> str:
    return hashlib.sha256(files.read(path)).hexdigest()


def _unbacked(entry: Entry, submission: Path | None, released: dict[str, str], episodes: int) -> str:
    """Why a row is not accepted; "" if it is. Its submission is verified again, if there is one."""
    if len(entry.costs) != episodes:
        return f"it has {len(entry.costs)} episodes, and not {episodes}"
    if any(getattr(entry, name) != value for name, value in entry.summary().items()):
        return "its success, falls or regret are not those of its episodes"
    if why := entry.too_good():
        return why
    if submission is not None:
        try:
            verified = verify(submission, episodes)
        except ValueError as error:
            return str(error)
        again = f"ballbot verify {submission} --write {LEADERBOARD.name}"
        return "" if verified == entry else f"its submission gives another row; {again}"
    if entry.file not in released:
        return f"its submission is neither in the folder nor downloaded, and no {LIST} that counts has the row"
    return "" if released[entry.file] == digest_of(entry) else f"it is not the row that {LIST} has"
