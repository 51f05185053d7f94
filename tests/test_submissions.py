"""Whoever submits to the leaderboard is believed nothing: each step of each episode must follow from the one before."""

from dataclasses import replace

import numpy as np
import pytest

from ballbot_gym import certified, dynamics, files, named_robot
from ballbot_gym.engines import PHYSICS, installed_physics
from ballbot_gym.env import make_task
from ballbot_train import evaluate
from ballbot_train.evaluation import recordings, submissions
from ballbot_train.evaluation.results import read_results
from ballbot_train.evaluation.submissions import SubmissionError, read_entries, submit, summary, verify

EPISODES = 2


@pytest.fixture(scope="module")
def submitted(tmp_path_factory):
    """A valid submission of a turn, with its folder of results, by physics."""
    made = {}

    def of(physics="rk4"):
        if physics not in made:
            folder = tmp_path_factory.mktemp(physics)
            evaluate("lqr", "turn", episodes=EPISODES, physics=physics, out=folder)
            (path,) = submit(folder, "mine", "https://example.org/mine", folder)
            made[physics] = folder, path
        return made[physics]

    return of


@pytest.fixture
def forge(submitted, tmp_path):
    """Writes the valid submission with changed facts or arrays, and verifies it."""

    def of(about=None, **changes):
        honest = recordings.read(submitted()[1])
        forged = replace(honest, about=honest.about | (about or {}), **changes)
        return verify(files.write(tmp_path / "forged.npz", recordings.to_bytes(forged)), EPISODES)

    return of


def changed(array, where, value):
    array = array.copy()
    array[where] = value
    return array


@pytest.mark.parametrize("physics", PHYSICS)
def test_an_honest_submission_has_the_row_of_its_evaluation(physics, submitted):
    if physics not in installed_physics():
        pytest.skip(f"{physics} is not installed")
    folder, path = submitted(physics)
    entry = verify(path, EPISODES)
    _, results = read_results(folder)
    assert entry.costs == pytest.approx([result.cost for result in results], rel=1e-6)
    assert entry.ends == ["success"] * EPISODES
    assert (entry.name, entry.link, entry.physics) == ("mine", "https://example.org/mine", physics)


def test_an_episode_without_a_plan_has_failed_at_the_full_price(submitted, tmp_path):
    honest = recordings.read(submitted()[1])
    first = honest.lengths[0]
    gave_up = replace(
        honest, lengths=changed(honest.lengths, 0, 0), states=honest.states[first + 1 :], actions=honest.actions[first:]
    )
    entry = verify(files.write(tmp_path / "gave-up.npz", recordings.to_bytes(gave_up)), EPISODES)
    assert (entry.falls, entry.ends, entry.costs[0]) == (1, ["no plan", "success"], 800.0)


def test_a_teleport_of_a_millimetre_is_refused(forge, submitted):
    honest = recordings.read(submitted()[1])
    states, rest = honest.states, slice(30, honest.lengths[0] + 1)
    with pytest.raises(
        SubmissionError, match=r"episode 0, step 30: the next state does not follow: x is off by 0\.001 m"
    ):
        forge(states=changed(states, (30, 0), states[30, 0] + 1e-3))
    with pytest.raises(
        SubmissionError, match=r"episode 0, step 30: the next state does not follow: y is off by 0\.001 m"
    ):
        forge(states=changed(states, (rest, 1), states[rest, 1] + 1e-3))


def test_a_changed_start_is_refused(forge, submitted):
    honest = recordings.read(submitted()[1])
    start = changed(honest.states, (0, 0), honest.states[0, 0] + 2e-8)
    with pytest.raises(SubmissionError, match=r"episode 0, step 0: it does not begin at its certified start$"):
        forge(states=start)


def test_another_action_and_one_beyond_its_limit_are_refused(forge, submitted):
    actions = recordings.read(submitted()[1]).actions
    with pytest.raises(SubmissionError, match=r"episode 0, step 4: the action \[1\.25, .*\] is beyond its limit of 1"):
        forge(actions=changed(actions, (3, 0), 1.25))
    with pytest.raises(SubmissionError, match="episode 0, step 4: the next state does not follow"):
        forge(actions=changed(actions, (3, 0), actions[3, 0] + 2e-6))


def test_an_end_that_is_none_is_refused(forge, submitted):
    honest = recordings.read(submitted()[1])
    shorter = {"lengths": honest.lengths - [0, 3], "states": honest.states[:-3], "actions": honest.actions[:-3]}
    with pytest.raises(
        SubmissionError, match=r"episode 1, step \d+: the recording stops here, and the episode has not"
    ):
        forge(**shorter)
    x = dynamics.step(named_robot("paper"), honest.states[-1:], np.zeros((1, 2)), 0.02)
    later = {
        "lengths": honest.lengths + [0, 1],
        "states": np.concatenate([honest.states, x]),
        "actions": np.concatenate([honest.actions, np.zeros((1, 2))]),
    }
    with pytest.raises(
        SubmissionError, match=r"episode 1, step \d+: the episode has ended here, and the recording goes on"
    ):
        forge(**later)


def test_costs_of_the_submitter_s_are_refused(submitted, tmp_path, forge):
    arrays = files.read_npz(submitted()[1])
    path = files.write_npz(tmp_path / "costs.npz", arrays | {"costs": np.ones(EPISODES)})
    with pytest.raises(files.FileError, match="holds costs, which no recording has: costs are computed"):
        verify(path, EPISODES)
    with pytest.raises(SubmissionError, match="lacks or adds regret_mean"):
        forge(about={"regret_mean": 0.0})


@pytest.mark.parametrize(
    ("about", "why"),
    [
        ({"link": "javascript:alert(1)"}, "link must be an address that begins with https://"),
        ({"link": "https://a b"}, "link must be an address"),
        ({"link": "https://a.org/) <img>"}, "link must be an address"),
        ({"name": "<b>mine</b>"}, "name must be of letters"),
        ({"name": "m" * 41}, "name must be text of at most 40"),
        ({"task": "os:system"}, "unknown task 'os:system'"),
        ({"task": "orbit"}, "the certified episodes are of Orbit"),
        ({"physics": "magic"}, "unknown physics"),
        ({"policy": "mine"}, "policy must be a SHA-256"),
        ({"versions": {"python": "3\n"}}, "versions must be short words"),
    ],
)
def test_what_a_file_says_about_itself_is_checked(about, why, forge):
    with pytest.raises(SubmissionError, match=why):
        forge(about=about)


def test_a_motion_of_another_engine_is_refused(submitted, tmp_path):
    honest = recordings.read(submitted("bullet")[1])
    renamed = replace(honest, about=honest.about | {"physics": "rk4"})
    path = files.write(tmp_path / "renamed.npz", recordings.to_bytes(renamed))
    with pytest.raises(SubmissionError, match="episode 0, step 1: the next state does not follow"):
        verify(path, EPISODES)


def test_too_few_episodes_are_refused(submitted):
    with pytest.raises(SubmissionError, match="holds 2 episodes, and not 200"):
        verify(submitted()[1])


def test_a_folder_of_several_controllers_must_be_told_which(submitted, tmp_path):
    honest = recordings.read(submitted()[1])
    for name in ("a", "b"):
        told = replace(honest, about=honest.about | {"controller": name})
        files.write(tmp_path / recordings.FOLDER / f"{name}.npz", recordings.to_bytes(told))
    with pytest.raises(ValueError, match="holds recordings of a, b; say which with --controller"):
        submit(tmp_path, "mine", "", tmp_path)
    assert [path.name for path in submit(tmp_path, "mine", "", tmp_path, "b")] == ["turn-mine.npz"]
    with pytest.raises(ValueError, match="holds no recordings; make them with evaluate"):
        submit(tmp_path / "nothing", "mine", "", tmp_path)


def test_motions_survive_the_way_through_bytes_and_file(rng, tmp_path):
    lengths = [3, 0, 5]
    motions = [
        (rng.integers(-(2**36), 2**36, (n + 1 if n else 0, 8)), rng.integers(-(2**28), 2**28, (n, 2))) for n in lengths
    ]
    grids = recordings.GRID, recordings.ACTION_GRID
    made = [
        recordings.Recording({}, np.array([n]), *(grid * part for grid, part in zip(grids, motion, strict=True)))
        for n, motion in zip(lengths, motions, strict=True)
    ]
    arrived = [recordings.read("bytes", recordings.to_bytes(each)) for each in made]
    ran = make_task("turn"), "turn", named_robot("paper"), "rk4", "mine"
    joined = recordings.read(recordings.write_in(tmp_path, arrived, *ran))
    assert joined.lengths.tolist() == lengths
    everything = tuple(map(np.concatenate, zip(*motions, strict=True)))
    for read, wanted in [*zip(arrived, motions, strict=True), (joined, everything)]:
        for part, grid, whole in zip((read.states, read.actions), grids, wanted, strict=True):
            np.testing.assert_array_equal(np.rint(part / grid), whole)


def test_of_a_simulation_that_exploded_what_no_number_holds_is_cut_off():
    exploded = recordings.Recording({}, np.array([1]), np.array([8 * [0.0], 8 * [-np.inf]]), np.array([[1e200, -1.0]]))
    read = recordings.read("bytes", recordings.to_bytes(exploded))
    assert read.states[1].tolist() == 8 * [-(2.0**36) * recordings.GRID]
    assert read.actions[0].tolist() == [2.0**36 * recordings.ACTION_GRID, -1.0]


ENTRIES = read_entries()


@pytest.mark.parametrize("entry", ENTRIES, ids=[entry.file for entry in ENTRIES])
def test_a_row_of_the_leaderboard_says_what_its_episodes_say(entry):
    assert (submissions.LEADERBOARD / entry.file).exists()
    assert len(entry.costs) == len(entry.ends) == certified.EPISODES
    assert summary(entry) == {name: getattr(entry, name) for name in summary(entry)}


@pytest.mark.parametrize("path", sorted(submissions.LEADERBOARD.glob("*.npz")), ids=lambda path: path.name)
def test_a_submission_beside_its_row_is_verified(path):
    """A pull request brings both. This takes seconds for each."""
    entry = verify(path)
    assert entry in ENTRIES, f"ballbot verify {path} --write leaderboard"


@pytest.mark.parametrize("task", ["stabilize", "turn"])
def test_the_rows_of_lqr_are_what_it_does_today(task, tmp_path):
    (entry,) = (entry for entry in ENTRIES if (entry.task, entry.name, entry.robot) == (task, "lqr", "paper"))
    if entry.physics not in installed_physics():
        pytest.skip(f"{entry.physics} is not installed")
    evaluate("lqr", task, episodes=2, physics=entry.physics, out=tmp_path)
    _, results = read_results(tmp_path)
    # the motion is unstable, so that other machines' rounding grows over an episode
    assert entry.costs[:2] == pytest.approx([result.cost for result in results], rel=1e-4)
