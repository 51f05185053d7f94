"""Data sets as shards hold what one file would hold, survive a kill, and are read one shard at a time."""

import hashlib
import json
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import fsspec
import numpy as np
import pytest

from ballbot_gym import files
from ballbot_gym.env import make_task
from ballbot_gym.robot import ROBOTS, named_robot, robot_name
from ballbot_train.commands.certify import certify
from ballbot_train.learning.datasets import command_of, load_demos
from ballbot_train.learning.demonstrations import DemoConfig, write_demos, write_shards
from ballbot_train.work import shards

TASK = make_task("turn")
CONFIG = DemoConfig("turn", "lqr", episodes=7, physics="rk4")


def numbered(log, numbers):
    with open(log, "a") as file:
        file.writelines(f"{i}\n" for i in numbers)
    return {"i": np.array(numbers)}


def made(url, out, episodes, about=None):
    about = {"seed": 1} if about is None else about
    log = str(out.parent / "log")
    return shards.Shards.make(url, about, episodes, partial(numbered, log), out, 1, "numbers", per_shard=7)


@pytest.mark.parametrize("where", ["folder", "memory"])
def test_every_episode_is_in_one_shard_in_order(where, tmp_path):
    url = str(tmp_path / "set") if where == "folder" else "memory://set-of-numbers"
    made(url, tmp_path / "out", 20)
    read = shards.Shards(url)
    assert [arrays["i"].tolist() for arrays in read] == [[*range(7)], [*range(7, 14)], [*range(14, 20)]]
    assert read.episodes == 20
    assert shards.Shards.is_at(url)
    assert not any((tmp_path / "out").iterdir())
    if where == "memory":
        fsspec.filesystem("memory").rm("/set-of-numbers", recursive=True)


def test_a_killed_run_goes_on_and_writes_no_shard_twice(tmp_path, monkeypatch):
    url, counted = str(tmp_path / "set"), []

    @contextmanager
    def killed(totals):
        def advance(name, count):
            counted.append(count)
            if sum(counted) >= 11:
                raise KeyboardInterrupt

        yield advance

    @contextmanager
    def kept(totals):
        assert totals == {"numbers": 20}
        yield lambda name, count: counted.append(count)

    monkeypatch.setattr(shards, "progress_bars", killed)
    with pytest.raises(KeyboardInterrupt):
        made(url, tmp_path / "out", 20)
    first = Path(url) / "shard-000000.npz"
    assert [path.name for path in Path(url).glob("*.npz")] == [first.name]
    stamp = first.stat().st_mtime_ns
    counted.clear()
    monkeypatch.setattr(shards, "progress_bars", kept)
    made(url, tmp_path / "out", 20)
    assert sum(counted) == 20
    assert first.stat().st_mtime_ns == stamp
    assert sorted(map(int, (tmp_path / "log").read_text().split())) == list(range(20))


def test_a_set_may_grow_and_is_never_mixed_with_another(tmp_path):
    url = str(tmp_path / "set")
    made(url, tmp_path / "out", 9)
    made(url, tmp_path / "out", 16)
    assert np.concatenate([arrays["i"] for arrays in shards.Shards(url)]).tolist() == list(range(16))
    with pytest.raises(ValueError, match="a set of seed 1, not 2"):
        made(url, tmp_path / "other", 9, about={"seed": 2})


def test_a_shard_that_was_changed_is_named(tmp_path):
    url = str(tmp_path / "set")
    made(url, tmp_path / "out", 9)
    files.write(Path(url) / "shard-000001.npz", files.npz({"i": np.arange(3)}))
    with pytest.raises(files.FileError, match=r"shard-000001\.npz is not the file that manifest\.json names"):
        list(shards.Shards(url))


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"version": 9}', '{"version": 1, "about": {}, "shards": {"0": {"file": "../x"}}}']
)
def test_a_damaged_manifest_is_named(text, tmp_path):
    (tmp_path / shards.MANIFEST).write_text(text)
    with pytest.raises(files.FileError, match=r"manifest\.json is damaged"):
        shards.Shards(tmp_path)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demos")
    write_demos(CONFIG, folder / "demos-v0", 1)
    write_shards(CONFIG, str(folder / "set"), folder / "out", 1, per_shard=3)
    return folder


def test_demonstrations_in_shards_are_those_of_one_dataset(demos):
    whole, sharded = load_demos(demos / "demos-v0", TASK), load_demos(demos / "set", TASK)
    for name, array in vars(whole).items():
        assert np.array_equal(vars(sharded)[name], array), name
        assert vars(sharded)[name].dtype == array.dtype
    assert f"--shards {demos / 'set'}" in command_of(demos / "set")
    with pytest.raises(ValueError, match="holds demonstrations of Turn"):
        load_demos(demos / "set", make_task("orbit"))


def test_shards_of_a_robot_are_of_its_own_task(tmp_path):
    config = DemoConfig("orbit", "lqr", episodes=2, physics="rk4", robot="rolling")
    write_shards(config, str(tmp_path / "set"), tmp_path / "out", 1)
    assert len(load_demos(tmp_path / "set", make_task("orbit", "rolling"), "rolling").actions) > 0
    with pytest.raises(ValueError, match="holds demonstrations of Orbit"):
        load_demos(tmp_path / "set", make_task("orbit"))
    with pytest.raises(ValueError, match="of the robot rolling, not of paper; make others with --robot"):
        load_demos(tmp_path / "set", make_task("orbit", "rolling"))


def test_demonstrations_of_a_robot_on_a_smoother_floor_are_those_of_the_robot_that_learners_know(tmp_path, monkeypatch):
    smoother = replace(named_robot("rolling"), friction=0.7)
    monkeypatch.setitem(ROBOTS, "smoother", replace(ROBOTS["rolling"], params=smoother))
    config = DemoConfig("orbit", "lqr", episodes=2, physics="rk4", robot="smoother")
    write_shards(config, str(tmp_path / "set"), tmp_path / "out", 1)
    for robot in ("smoother", robot_name(smoother)):
        assert len(load_demos(tmp_path / "set", make_task("orbit", "smoother"), robot).actions) > 0


def test_certified_shards_are_the_certified_set(tmp_path):
    certify(("stabilize",), 6, out=tmp_path / "set", workers=1)
    certify(("stabilize",), 6, shards=str(tmp_path / "shards"), out=tmp_path / "out", workers=1)
    whole = files.read_npz(tmp_path / "set" / "BallbotStabilize-v0.npz")
    (arrays,) = shards.Shards(tmp_path / "shards" / "stabilize")
    for name in ("states", "constants", "costs", "violations", "statuses", "lengths", "x", "u"):
        assert np.array_equal(arrays[name], whole[name]), name
    assert arrays["episodes"].tolist() == list(range(6))
    assert json.loads((tmp_path / "shards" / "stabilize" / shards.MANIFEST).read_text())["shards"]["0"]["episodes"] == 6


@pytest.mark.parametrize(
    "url",
    [
        "reference://x",
        "simplecache::http://localhost:9/x",
        "filecache://x",
        "zip://a::file:///tmp/b.zip",
        "github://a:b@c/d",
        "s3://a::file:///b",
        "dir://x",
        "blockcache://x",
    ],
)
def test_addresses_that_are_no_storage_are_refused(url):
    with pytest.raises(
        files.FileError, match=r"cannot be read: .*is not a supported storage; give a folder, or a URL that begins with"
    ):
        shards.Shards(url)


@pytest.mark.parametrize("name", ["what?", "a::b", "a#b", "50%25", "*", "[x]", "{x}"])
def test_a_set_is_in_its_folder_whatever_that_is_called(name, tmp_path):
    made(str(tmp_path / name), tmp_path / "out", 9)
    assert {path.name for path in tmp_path.iterdir()} == {name, "out", "log"}
    assert shards.Shards(tmp_path / name).episodes == 9


@pytest.mark.parametrize("of", ["episodes", "number"])
@pytest.mark.parametrize("value", [10**9, -1])
def test_a_manifest_of_impossible_sizes_is_damaged(of, value, tmp_path):
    made(str(tmp_path / "set"), tmp_path / "out", 9)
    path = tmp_path / "set" / shards.MANIFEST
    manifest = json.loads(path.read_text())
    if of == "episodes":
        manifest["shards"]["0"]["episodes"] = value
    else:
        manifest["shards"][str(value)] = manifest["shards"].pop("0")
    path.write_text(json.dumps(manifest))
    with pytest.raises(files.FileError, match=r"manifest\.json is damaged .*at most 1000000 are possible"):
        shards.Shards(tmp_path / "set")


def test_a_shard_that_unpacks_to_far_more_than_it_holds_is_refused(tmp_path):
    made(str(tmp_path / "set"), tmp_path / "out", 5)
    path = files.write(tmp_path / "set" / "shard-000000.npz", files.npz({"i": np.zeros(2**24, np.uint8)}))
    assert path.stat().st_size < 2**15
    manifest = json.loads((tmp_path / "set" / shards.MANIFEST).read_text())
    manifest["shards"]["0"]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    (tmp_path / "set" / shards.MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(files.FileError, match="unpacks to 16 MiB; at most 0 MiB are read"):
        list(shards.Shards(tmp_path / "set"))
