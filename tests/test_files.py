"""What is written replaces files alone, and what is loaded belongs to its user."""

import os
from pathlib import Path

import pytest

from ballbot_gym import Stabilize, files, machine_code, named_robot
from ballbot_gym.certified import cache

SOURCE = "int answer(void) { return 42; }\n"

pytestmark = pytest.mark.skipif(os.name != "posix", reason="POSIX alone has devices, owners and modes")


def test_no_device_pipe_or_folder_is_replaced_by_a_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for path in ("/dev/null", tmp_path / "pipe", tmp_path / "folder"):
        with pytest.raises(files.FileError, match="is not a regular file"):
            files.write(path, "text")
    assert Path("/dev/null").is_char_device()
    assert (tmp_path / "pipe").is_fifo()


def test_a_link_in_the_place_of_a_file_leads_nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    victim = tmp_path / "victim"
    victim.write_text("mine")
    monkeypatch.setattr(files.secrets, "token_hex", lambda size: "guessed")
    (tmp_path / ".out.guessed.tmp").symlink_to(victim)
    with pytest.raises(FileExistsError):
        files.write(tmp_path / "out", "text")
    assert victim.read_text() == "mine"


def test_files_have_the_modes_that_the_user_asks_for(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        assert files.write(tmp_path / "out", "text").stat().st_mode & 0o777 == 0o640
    finally:
        os.umask(before)


@pytest.mark.skipif(machine_code.compiler() is None, reason="there is no C compiler")
def test_a_library_into_which_others_could_write_is_built_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BALLBOT_CACHE", str(tmp_path / "cache"))
    path = machine_code.library("answer", SOURCE)
    built = path.stat().st_ino
    assert machine_code.library("answer", SOURCE).stat().st_ino == built
    path.chmod(0o777)
    assert machine_code.library("answer", SOURCE).stat().st_ino != built
    path.unlink()
    os.mkfifo(path)
    assert machine_code.library("answer", SOURCE).is_file()


def test_optima_are_not_read_from_a_folder_into_which_others_may_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BALLBOT_OPTIMA", str(tmp_path))
    tmp_path.chmod(0o777)
    with pytest.raises(ValueError, match=r"others may write into .*; run \"chmod go-w\" on it"):
        cache.folder(Stabilize(), named_robot("paper"))
    tmp_path.chmod(0o755)
    assert cache.folder(Stabilize(), named_robot("paper")).parent == tmp_path
