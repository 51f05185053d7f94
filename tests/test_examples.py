import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from builders import script

from ballbot_train import evaluate

EXAMPLES = Path(__file__).parent.parent / "examples"


def test_a_policy_in_ten_lines_is_compared_with_lqr_and_trajectory_optimization(capsys):
    script(EXAMPLES / "compare_your_policy.py").main(episodes=2)
    printed = capsys.readouterr().out
    for name in ("mine", "lqr", "trajopt", "regret"):
        assert name in printed


def test_plain_ppo_reports_what_it_has_learnt(capsys, tmp_path):
    path = tmp_path / "model.zip"
    options = {"n_steps": 16, "batch_size": 32, "n_epochs": 1, "learning_rate": 1e-3, "falling": True}
    script(EXAMPLES / "train_ppo.py").main(
        steps=64, envs=2, every=32, relu=True, net_arch=(4,), save=str(path), **options
    )
    printed = capsys.readouterr().out
    assert "5 settings: learning_rate, n_steps, batch_size, n_epochs, policy_kwargs" in printed
    assert printed.count("success") == 2
    assert path.exists()


def test_plain_ppo_trains_and_is_measured_on_certified_episodes(capsys):
    script(EXAMPLES / "plain_ppo.py").main(steps=16, episodes=2)
    printed = capsys.readouterr().out
    assert "failures in 2" in printed


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_plain_ppo_comes_to_rest_in_the_goal(seed):
    torch.set_num_threads(1)
    example = script(EXAMPLES / "plain_ppo.py")
    began = time.process_time()
    model = example.train(example.STEPS, seed)
    seconds = time.process_time() - began
    row = evaluate(model, "stabilize")
    print(seconds, row, row.near, row.regret_median, row.physics)  # what the pages say, with pytest -s
    assert row.success >= 0.95
    assert row.regret_mean < 0.15
    assert seconds < 600  # five minutes of two cores


def test_learning_curves_are_of_all_seeds_of_a_folder(capsys, tmp_path):
    for seed, regrets in enumerate(((4.0, 2.0, 0.0), (4.0, 4.0))):
        (tmp_path / "runs" / f"seed-{seed}").mkdir(parents=True)
        rows = "".join(f"{60 * i},{1 + regret}\n" for i, regret in enumerate(regrets))
        (tmp_path / "runs" / f"seed-{seed}" / "evaluations.csv").write_text(f"cpu_seconds,cost_ratio\n{rows}")
    script(EXAMPLES / "learning_curves.py").main((tmp_path / "runs",), tmp_path / "curves.png")
    assert "median 200.00%, worst 400.00% of 2 seeds" in capsys.readouterr().out
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_a_search_trains_with_proposed_settings_and_continues_its_study(capsys, tmp_path, typed, monkeypatch):
    pytest.importorskip("optuna")
    example = script(EXAMPLES / "tune.py")
    trained = []

    def run(command, check):  # in this process, because each new one takes seconds to import what it needs
        assert (command[1:3], check) == (["-m", "ballbot_train.cli"], True)
        trained.append(typed(*command[3:]))
        assert trained[-1][0] == 0, trained[-1][1]

    own = SimpleNamespace(run=run, CalledProcessError=subprocess.CalledProcessError)
    monkeypatch.setattr(example, "subprocess", own)
    tiny = "--iterations 1 --evaluations 1 --num-envs 4 --batch-size 16 --hidden 4 --test-episodes 1 --validation-episodes 2"
    for _ in range(2):  # the second time there is nothing left to do
        example.main("stabilize", 1, 1, f"{tiny} --episode-seconds 1", tmp_path)
    assert len(trained) == 1
    assert capsys.readouterr().out.count("the best, trial 0, costs") == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["study.db", "trial-0"]
