"""value_learning_gridworld.py: TD(0) and its traps, V^π, and the command line."""

import json

import numpy as np
import pytest
import value_learning_gridworld as script
from gridworld_oracles import ACTING, ACTIONS, CELLS, FIGURE_10, Transcript, assert_refused, values
from gymnasium.wrappers import TimeLimit
from value_learning_gridworld import Args, GridWorld

POLICY = {s: ACTIONS.index(action) for s, action in FIGURE_10.items()}


def learn(env, **settings):
    *_, (V, N) = script.value_learning(env, POLICY, Args(**settings))
    return np.array(V), np.array(N)


class TestLinearSystem:
    @pytest.mark.parametrize(("slip", "step_reward", "discount"), [
        (0.2, -0.025, 1), (0.5, 0.1, 1), (0.2, -0.04, 0.9), (0, -1, 0.5)])
    def test_against_plain_sweeps(self, slip, step_reward, discount):
        V = script.exact_values(GridWorld(slip, step_reward), POLICY, discount)
        assert V == pytest.approx(values(FIGURE_10, slip, step_reward, discount), abs=1e-9)

    @pytest.mark.parametrize("slip", [0.0, 1e-20])
    def test_a_policy_that_never_ends(self, slip):
        with pytest.raises(SystemExit):
            script.exact_values(GridWorld(slip), POLICY, 1.0)  # (3,2) runs into the wall


class TestAlgorithm:
    def test_v_is_the_update_of_the_transitions(self):
        env = Transcript(TimeLimit(GridWorld(), 4))
        V, N = learn(env, episodes=300, discount=0.9)
        expected, visits = np.zeros(11), np.zeros(11)
        for s, a, r, s_next, terminated in env.transitions:
            assert a == POLICY[s]
            visits[s] += 1
            target = r + (0 if terminated else 0.9 * expected[s_next])
            expected[s] += visits[s] ** -0.7 * (target - expected[s])
        assert V == pytest.approx(expected, abs=1e-12) and (N == visits).all()
        assert (V[[6, 10]] == 0).all() and (N[[6, 10]] == 0).all()  # terminals

    def test_starts(self):
        for exploring, least in ((False, 0), (True, 60)):
            env = Transcript(TimeLimit(GridWorld(), 1))
            learn(env, episodes=900, exploring_starts=exploring)
            starts = [ACTING.index(s) for s, *_ in env.transitions]
            assert (np.bincount(starts, minlength=9) >= least).all() and any(starts) == exploring
        slips = np.random.default_rng(env.unwrapped.np_random_seed)  # other numbers than these
        assert starts != slips.integers(9, size=900).tolist()

    def test_converges(self):
        tables = [learn(GridWorld(), seed=seed)[0] for seed in (7, 7, 8)]
        assert tables[0] == pytest.approx(values(FIGURE_10), abs=0.06)
        assert (tables[0] == tables[1]).all() and (tables[0] != tables[2]).any()


class TestCommandLine:
    def test_defaults(self, command_line, tmp_path):
        done = command_line("value_learning_gridworld.py", "--episodes", 2000)
        assert done.returncode == 0 and "Warning" not in done.stderr, done.stderr
        (run,) = (tmp_path / "runs").glob("GridWorld__value_learning_gridworld__0__*")
        result = json.loads((run / "values.json").read_text(encoding="utf-8"))
        for s in ACTING:
            cell = result[str(CELLS[s])]
            assert cell["action"] == FIGURE_10[s]
            assert cell["V^π"] == pytest.approx(values(FIGURE_10)[s])
            assert f"{cell['V']:.3f}" in done.stdout and f"{cell['V^π']:.3f}" in done.stdout
        assert [*run.glob("events*")] and (run / "figure.png").read_bytes().startswith(b"\x89PNG")

    def test_a_policy_of_ones_own_and_a_cell_never_visited(self, tmp_path, monkeypatch):
        policy = Args().policy.replace("3,2=left", "3,2=up")
        flags = ["--policy", policy, "--no-exploring-starts", "--episodes", "5"]
        monkeypatch.setattr("sys.argv", ["", *flags, "--runs-dir", str(tmp_path)])
        script.main()
        result = json.loads(next(tmp_path.glob("*/values.json")).read_text(encoding="utf-8"))
        exact = values(FIGURE_10 | {5: "up"})
        assert result["(3, 2)"]["V^π"] == pytest.approx(exact[5])
        assert result["(4, 1)"]["V"] is None

    @pytest.mark.parametrize("flags", [
        "--episodes 0", "--discount nan", "--learning-rate 2", "--slip-probability -0.1",
        "--seed -1", "--step-reward inf", "--slip-probability 0", "--runs-dir file",
        "--policy 1,1=up", "--policy up", "2,2=up", "4,3=up", "1,1=jump"])
    def test_bad_input(self, flags, tmp_path, monkeypatch):
        policy = ["--policy", f"{Args().policy} {flags}"]  # the default and one item more
        assert_refused(script, flags.split() if "--" in flags else policy, tmp_path, monkeypatch)
