"""Whoever submits to the leaderboard is believed nothing: each step of each episode must follow from the one before."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballbot_baselines.feedback.lqr import equilibrium_gain
from ballbot_baselines.solvers.riccati import discrete_lqr
from ballbot_gym import certified, files, named_robot
from ballbot_gym.engines import PHYSICS, installed_physics, make_simulator
from ballbot_gym.env import make_task
from ballbot_train import evaluate
from ballbot_train.commands.submit import submit as submit_command
from ballbot_train.evaluation import recordings, submissions
from ballbot_train.evaluation.results import read_results
from ballbot_train.evaluation.steering import costates
from ballbot_train.evaluation.submissions import SubmissionError, pack, read_entries, verify

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))
from released import digest_of, release, unbacked

sys.path.pop(0)

EPISODES = 2


def submit(results, name, link, out, controller=""):
    """Writes what would be submitted without verifying it, because it has fewer episodes than a submission."""
    return [files.write(out / file, content) for file, content in pack(results, name, link, controller).items()]


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
        honest = recordings.Recording.read(submitted()[1])
        forged = replace(honest, about=honest.about | (about or {}), **changes)
        return verify(files.write(tmp_path / "forged.npz", forged.to_bytes()), EPISODES)

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
    honest = recordings.Recording.read(submitted()[1])
    first = honest.lengths[0]
    gave_up = replace(
        honest, lengths=changed(honest.lengths, 0, 0), states=honest.states[first + 1 :], actions=honest.actions[first:]
    )
    entry = verify(files.write(tmp_path / "gave-up.npz", gave_up.to_bytes()), EPISODES)
    assert (entry.falls, entry.ends, entry.costs[0]) == (1, ["no plan", "success"], 800.0)


def test_a_teleport_of_a_millimetre_is_refused(forge, submitted):
    honest = recordings.Recording.read(submitted()[1])
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
    honest = recordings.Recording.read(submitted()[1])
    start = changed(honest.states, (0, 0), honest.states[0, 0] + 2e-8)
    with pytest.raises(SubmissionError, match=r"episode 0, step 0: it does not begin at its certified start$"):
        forge(states=start)


def test_another_action_and_one_beyond_its_limit_are_refused(forge, submitted):
    actions = recordings.Recording.read(submitted()[1]).actions
    with pytest.raises(SubmissionError, match=r"episode 0, step 4: the action \[1\.25, .*\] is beyond its limit of 1"):
        forge(actions=changed(actions, (3, 0), 1.25))
    with pytest.raises(SubmissionError, match="episode 0, step 4: the next state does not follow"):
        forge(actions=changed(actions, (3, 0), actions[3, 0] + 2e-6))


def test_an_end_that_is_none_is_refused(forge, submitted):
    honest = recordings.Recording.read(submitted()[1])
    shorter = {"lengths": honest.lengths - [0, 3], "states": honest.states[:-3], "actions": honest.actions[:-3]}
    with pytest.raises(
        SubmissionError, match=r"episode 1, step \d+: the recording stops here, but the episode has not"
    ):
        forge(**shorter)
    x = named_robot("paper").step(honest.states[-1:], np.zeros((1, 2)), 0.02)
    later = {
        "lengths": honest.lengths + [0, 1],
        "states": np.concatenate([honest.states, x]),
        "actions": np.concatenate([honest.actions, np.zeros((1, 2))]),
    }
    with pytest.raises(
        SubmissionError, match=r"episode 1, step \d+: the episode has ended here, but the recording continues"
    ):
        forge(**later)


def test_costs_of_the_submitter_s_are_refused(submitted, tmp_path, forge):
    arrays = files.read_npz(submitted()[1])
    path = files.write(tmp_path / "costs.npz", files.npz(arrays | {"costs": np.ones(EPISODES)}))
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
        ({"link": "https://a.org/|0.00%|"}, "link must be an address"),
        ({"link": "https://a.org/\\"}, "link must be an address"),
        ({"link": "https://a.org]x"}, "link must be an address"),
        ({"link": "https://github.com@b.org"}, "link must be an address"),
        ({"link": "https://"}, "link must be an address"),
        ({"task": "../../a"}, "unknown task"),
        ({"name": "<b>mine</b>"}, "name must be of letters"),
        ({"name": "m" * 41}, "name must be text of at most 40"),
        ({"task": "os:system"}, "unknown task 'os:system'"),
        ({"task": "orbit"}, "the certified episodes are those of Orbit"),
        ({"physics": "magic"}, "unknown physics"),
        ({"policy": "mine"}, "policy must be a SHA-256"),
        ({"versions": {"python": "3\n"}}, "versions must be short words"),
    ],
)
def test_what_a_file_says_about_itself_is_checked(about, why, forge):
    with pytest.raises(SubmissionError, match=why):
        forge(about=about)


def test_a_motion_of_another_engine_is_refused(submitted, tmp_path):
    honest = recordings.Recording.read(submitted("bullet")[1])
    renamed = replace(honest, about=honest.about | {"physics": "rk4"})
    path = files.write(tmp_path / "renamed.npz", renamed.to_bytes())
    with pytest.raises(SubmissionError, match="episode 0, step 1: the next state does not follow"):
        verify(path, EPISODES)


def test_too_few_episodes_are_refused(submitted):
    with pytest.raises(SubmissionError, match="holds 2 episodes, and not 200"):
        verify(submitted()[1])


def test_a_folder_of_several_controllers_must_be_told_which(submitted, tmp_path):
    honest = recordings.Recording.read(submitted()[1])
    for name in ("a", "b"):
        told = replace(honest, about=honest.about | {"controller": name})
        files.write(tmp_path / recordings.FOLDER / f"{name}.npz", told.to_bytes())
    with pytest.raises(ValueError, match="holds recordings of a, b; say which with --controller"):
        submit(tmp_path, "mine", "", tmp_path)
    assert [path.name for path in submit(tmp_path, "mine", "", tmp_path, "b")] == ["turn-mine-rk4.npz"]
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
    arrived = [recordings.Recording.read("bytes", each.to_bytes()) for each in made]
    ran = make_task("turn"), "turn", named_robot("paper"), "rk4", "mine"
    joined = recordings.Recording.read(recordings.Recording.of_run(arrived, *ran).write_in(tmp_path))
    assert joined.lengths.tolist() == lengths
    everything = tuple(map(np.concatenate, zip(*motions, strict=True)))
    for read, wanted in [*zip(arrived, motions, strict=True), (joined, everything)]:
        for part, grid, whole in zip((read.states, read.actions), grids, wanted, strict=True):
            np.testing.assert_array_equal(np.rint(part / grid), whole)


def test_of_a_simulation_that_exploded_what_no_number_holds_is_cut_off():
    exploded = recordings.Recording({}, np.array([1]), np.array([8 * [0.0], 8 * [-np.inf]]), np.array([[1e200, -1.0]]))
    read = recordings.Recording.read("bytes", exploded.to_bytes())
    assert read.states[1].tolist() == 8 * [-(2.0**36) * recordings.GRID]
    assert read.actions[0].tolist() == [2.0**36 * recordings.ACTION_GRID, -1.0]


def attack(physics, robot, steer, steps=400):
    """A submission of two episodes of LQR in Stabilize in whose every step an error lowers the cost."""
    task, params = make_task("stabilize", robot), named_robot(robot)
    known, regulator = certified.load(task, robot).first(EPISODES), equilibrium_gain(task, params)
    assert regulator is not None
    simulator = make_simulator(physics, params, task.control_dt)
    x, action, slopes = [], [], np.zeros((EPISODES, steps, 8))
    for error in (0.0, steer):
        x, action = [], []
        for i, (start, c) in enumerate(zip(known.states, known.constants, strict=True)):
            states = [start]
            for slope in slopes[i]:
                action.append(np.clip(regulator[0] @ np.array(task.observe(states[-1], c)), -1, 1))
                simulator.reset(tuple(states[-1]))
                reached = np.array(simulator.step(tuple(params.force_limit * action[-1])))
                states.append(reached - error * np.sign(slope))
            x.append(np.array(states))
            slopes[i] = costates(task, params, x[-1], np.array(action[-steps:]), c)
    simulator.close()
    about = {"task": "stabilize", "problem": task.problem(), "robot": robot, "physics": physics, "controller": "lqr"}
    about |= {"policy": "", "versions": {}, "name": "steered", "link": ""}
    return recordings.Recording(about, np.full(EPISODES, steps), np.concatenate(x), np.array(action))


@pytest.mark.parametrize(("robot", "physics", "error"), [("kugle", "mujoco", 8.5e-5), ("kugle", "bullet", 3e-5)])
def test_small_errors_of_every_step_that_together_lower_the_cost_are_refused(robot, physics, error, tmp_path):
    if physics not in installed_physics():
        pytest.skip(f"{physics} is not installed")
    honest = files.write(tmp_path / "honest.npz", attack(physics, robot, 0.0).to_bytes())
    entry = verify(honest, EPISODES)
    assert (entry.success, entry.steered) == (1.0, 1e-4)
    steered = files.write(tmp_path / "steered.npz", attack(physics, robot, error).to_bytes())
    with pytest.raises(
        SubmissionError, match=r"episode 0: the small errors .* changed its cost by \d.*0\.01% is allowed"
    ):
        verify(steered, EPISODES)


def test_a_costate_is_the_slope_of_the_cost_of_a_motion_that_is_steered_back():
    """LQR's cost-to-go is xᵀPx near rest, and its slope is 2Px."""
    task, params = make_task("stabilize"), named_robot("paper")
    k, p = discrete_lqr(task, params, np.zeros(8), np.zeros(2), np.zeros(0))
    states, forces = [np.array([1e-3, 0, 0, 1e-4, 0, 0, 0, 0])], []
    for _ in range(task.steps):
        forces.append(-k @ states[-1])
        states.append(params.step(states[-1][None], forces[-1][None], task.control_dt, 4)[0])
    slopes = costates(task, params, np.array(states), np.array(forces) / params.force_limit, np.zeros(0))
    expected = 2 * p @ states[10]
    np.testing.assert_allclose(slopes[9], expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("physics", ["bullet", "mujoco"])
def test_a_ball_that_slips_within_a_step_is_refused(physics, tmp_path):
    """The verifier starts each step with a ball that rolls, so every step alone could follow."""
    if physics not in installed_physics():
        pytest.skip(f"{physics} is not installed")
    params, known = named_robot("rolling"), certified.load("stabilize", "rolling").first(EPISODES)
    simulator, states = make_simulator(physics, params, 0.02), []
    for start in known.states:
        states.append(start)
        for _ in range(3):
            simulator.reset(tuple(states[-1]))
            states.append(np.array(simulator.step((params.force_limit, 0.0))))
    simulator.close()
    about = attack("rk4", "rolling", 0.0, 1).about | {"physics": physics}
    recording = recordings.Recording(about, np.full(EPISODES, 3), np.array(states), np.tile([1.0, 0.0], (6, 1)))
    with pytest.raises(SubmissionError, match=r"episode 0, step 1: the ball slips at \d.* m/s"):
        verify(files.write(tmp_path / "slips.npz", recording.to_bytes()), EPISODES)


def test_costs_below_what_the_engine_explains_are_refused(submitted):
    entry = verify(submitted()[1], EPISODES)
    assert entry.too_good() == ""
    optima = [result.optimum for result in entry.results()]
    assert (
        "episode 0 costs 50.000% less than the optimum" in replace(entry, costs=[optima[0] / 2, optima[1]]).too_good()
    )
    little = replace(entry, physics="bullet", costs=[0.995 * cost for cost in optima])
    assert "the mean of all episodes costs 0.500% less" in replace(little, **little.summary()).too_good()


def test_a_row_needs_its_submission_or_a_line_in_the_list_of_releases(submitted, tmp_path):
    entry = verify(submitted()[1], EPISODES)
    row, submission = entry.write(tmp_path), tmp_path / "turn-mine-rk4.npz"
    (missing,) = unbacked(tmp_path, EPISODES)
    assert missing.startswith("turn-mine-rk4.json: its submission is neither in the folder nor downloaded")
    files.write(submission, submitted()[1].read_bytes())
    assert unbacked(tmp_path, EPISODES) == []
    release(tmp_path, EPISODES)
    submission.unlink()
    assert unbacked(tmp_path, EPISODES) == []
    replace(entry, link="https://example.org/other").write(tmp_path)
    assert unbacked(tmp_path, EPISODES) == ["turn-mine-rk4.json: it is not the row that released.txt has"]
    with pytest.raises(ValueError, match="it is not the row"):
        release(tmp_path, EPISODES)
    replace(entry, regret_mean=-0.5).write(tmp_path)
    assert unbacked(tmp_path, EPISODES) == [
        "turn-mine-rk4.json: its success, falls or regret are not those of its episodes"
    ]
    row.unlink()
    assert unbacked(tmp_path, EPISODES) == ["turn-mine-rk4.json: the row is missing, and released.txt has it"]
    entry.write(tmp_path).rename(tmp_path / "turn-other.json")
    assert "turn-other.json: the name of the file is not that of its row" in unbacked(tmp_path, EPISODES)
    files.write(tmp_path / "released.txt", "turn-other.json\n")
    with pytest.raises(files.FileError, match="each line must be a digest, two spaces and the name"):
        unbacked(tmp_path, EPISODES)


@pytest.mark.parametrize(
    "change", [{"task": "os:system"}, {"link": "https://a.org/|x|"}, {"costs": ["1"]}, {"ends": ["<b>"] * EPISODES}]
)
def test_rows_that_were_not_verified_are_not_read(change, submitted, tmp_path):
    replace(verify(submitted()[1], EPISODES), **change).write(tmp_path)
    with pytest.raises(files.FileError, match=r"unknown task|link must|costs must be numbers|unknown end"):
        read_entries(tmp_path)


def test_a_refused_submission_replaces_and_removes_nothing(submitted, tmp_path):
    folder, out = submitted()[0], tmp_path / "out"
    earlier = files.write(out / "turn-mine-rk4.npz", b"earlier")
    with pytest.raises(SubmissionError, match="holds 2 episodes, and not 200"):
        submit_command(folder, name="mine", out=out)
    assert earlier.read_bytes() == b"earlier"
    (path,) = (folder / recordings.FOLDER).glob("*.npz")
    recording = recordings.Recording.read(path)
    elsewhere = replace(recording, about=recording.about | {"task": "../../elsewhere"})
    files.write(tmp_path / "run" / recordings.FOLDER / "a.npz", elsewhere.to_bytes())
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SubmissionError, match=r"unknown task '\.\./\.\./elsewhere'"):
        submit(tmp_path / "run", "mine", "", out)
    assert sorted(tmp_path.rglob("*")) == before


def test_another_submission_of_the_same_name_is_not_overwritten(submitted, tmp_path, monkeypatch):
    monkeypatch.setattr(submissions, "verify", lambda path, content=None: verify(path, EPISODES, content))
    folder, out = submitted()[0], tmp_path / "out"
    submit_command(folder, name="mine", out=out)
    before = (out / "turn-mine-rk4.npz").read_bytes()
    submit_command(folder, name="mine", out=out)
    with pytest.raises(SubmissionError, match="is another submission of this name"):
        submit_command(folder, name="mine", link="https://example.org/other", out=out)
    assert (out / "turn-mine-rk4.npz").read_bytes() == before


def test_a_row_says_whose_motion_it_is(submitted, tmp_path):
    entry = verify(submitted()[1], EPISODES)
    assert entry.optima == 0
    other = replace(entry, name="other", costs=[cost * (1 + 1e-7) for cost in entry.costs])
    assert entry.copies([entry, other, replace(other, physics="bullet")]) == ["other"]
    assert entry.copies([replace(other, costs=[cost * 1.001 for cost in entry.costs])]) == []
    known = certified.load("turn", "paper", episodes=range(EPISODES))
    optima = [known.trajectories[i] for i in range(EPISODES)]
    honest = recordings.Recording.read(submitted()[1])
    replayed = replace(
        honest,
        lengths=np.array([len(optimum.u) for optimum in optima]),
        states=np.concatenate([optimum.x for optimum in optima]),
        actions=np.concatenate([optimum.u for optimum in optima]) / named_robot("paper").force_limit,
    )
    entry = verify(files.write(tmp_path / "optima.npz", replayed.to_bytes()), EPISODES)
    assert entry.optima == EPISODES


ENTRIES = read_entries()


@pytest.mark.parametrize("entry", ENTRIES, ids=[entry.file for entry in ENTRIES])
def test_a_row_of_the_leaderboard_says_what_its_episodes_say(entry):
    assert (submissions.LEADERBOARD / entry.file).exists()
    assert len(entry.costs) == len(entry.ends) == certified.EPISODES
    assert entry.summary() == {name: getattr(entry, name) for name in entry.summary()}


def test_every_row_is_backed_by_a_submission_beside_it_or_in_a_release():
    """A pull request brings both. This takes seconds for each submission.

    With $BALLBOT_RECORDINGS, the folder of the submissions of all releases, no list is believed: `make verify` sets it.
    """
    downloaded = os.environ.get("BALLBOT_RECORDINGS")
    assert unbacked(downloaded=Path(downloaded) if downloaded else None) == []


def test_a_row_and_its_line_in_the_list_that_are_edited_together_do_not_match_the_recording(submitted, tmp_path):
    """A pull request can change both. So a reviewer verifies the recordings of releases, which it cannot change."""
    board, downloaded = tmp_path / "board", tmp_path / "downloaded"
    entry = verify(submitted()[1], EPISODES)
    entry.write(board)
    files.write(downloaded / "any-name.npz", submitted()[1].read_bytes())
    files.write(board / "released.txt", f"{digest_of(entry)}  {entry.file}\n")
    assert unbacked(board, EPISODES) == unbacked(board, EPISODES, downloaded) == []
    better = replace(entry, costs=[1.001 * result.optimum for result in entry.results()])
    better = replace(better, **better.summary())
    for forged in (better, replace(better, submission="0" * 64)):
        (board / entry.file).unlink()
        forged.write(board)
        files.write(board / "released.txt", f"{digest_of(forged)}  {forged.file}\n")
        assert unbacked(board, EPISODES) == []
        (wrong,) = unbacked(board, EPISODES, downloaded)
        assert (
            "its submission gives another row" in wrong
            or "its submission is neither in the folder nor downloaded" in wrong
        )


@pytest.mark.parametrize("task", ["stabilize", "turn"])
def test_the_rows_of_lqr_are_what_it_does_today(task, tmp_path):
    (entry,) = (entry for entry in ENTRIES if (entry.task, entry.name, entry.robot) == (task, "lqr", "paper"))
    if entry.physics not in installed_physics():
        pytest.skip(f"{entry.physics} is not installed")
    evaluate("lqr", task, episodes=2, physics=entry.physics, out=tmp_path)
    _, results = read_results(tmp_path)
    # the motion is unstable, so that other machines' rounding grows over an episode
    assert entry.costs[:2] == pytest.approx([result.cost for result in results], rel=1e-4)


def test_a_row_is_not_overwritten_by_another_submission_of_its_name(submitted, tmp_path):
    entry = verify(submitted()[1], EPISODES)
    row = entry.write(tmp_path)
    assert entry.write(tmp_path) == row
    before = row.read_bytes()
    with pytest.raises(SubmissionError, match="is the row of another submission of this name"):
        replace(entry, submission="0" * 64).write(tmp_path)
    assert row.read_bytes() == before
