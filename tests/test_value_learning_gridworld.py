"""value_learning_gridworld.py: TD(0) and its traps, V^π of the linear system, what is written, and what is refused."""

import json
from fractions import Fraction

import numpy as np
import pytest
import value_learning_gridworld as script
from gridworld_oracles import (
    ACTIONS,
    CELLS,
    DECIDING,
    OPTIMAL,
    PAID,
    Transcript,
    assert_refused,
    run_main,
    scalars,
    transitions,
)
from gymnasium.wrappers import TimeLimit
from matplotlib.figure import Figure
from value_learning_gridworld import Args, GridWorld

POLICY = [ACTIONS.index(OPTIMAL.get("({},{})".format(*cell), "left")) for cell in CELLS]
AS_FLAG = " ".join(f"{name[1:-1]}={action}" for name, action in OPTIMAL.items())
LEFT = " ".join(f"{x},{y}=left" for x, y in CELLS if (x, y) not in PAID)
NAMES = ["({},{})".format(*cell) for cell in CELLS]


def learn(env, policy=POLICY, **settings):
    """The last estimate of a run."""
    *_, last = script.value_learning(env, np.array(policy), Args(**settings))
    return last


def plain_values(policy, slip, step_reward, discount):
    """V^π of the nine cells by sweeps over the transitions, one number at a time, until nothing changes."""
    model = transitions(slip, step_reward)
    model = {CELLS[s]: model[CELLS[s], ACTIONS[policy[s]]] for s in DECIDING}
    model = {cell: [(float(p), c, float(r)) for (c, r), p in outcomes.items()] for cell, outcomes in model.items()}
    V, previous = dict.fromkeys(CELLS, 0.0), None
    for _ in range(100_000):
        if V == previous:
            break
        previous = dict(V)
        for cell, outcomes in model.items():
            V[cell] = sum(p * (r + discount * V[target]) for p, target, r in outcomes)
    return [V[CELLS[s]] for s in DECIDING]


def linear_system(policy, world, discount):
    """V^π (11,) by the script."""
    P, R = script.model_matrices(world.P, 11, 4)
    rows = np.arange(11) * 4 + np.array(policy)
    return script.policy_values(P[rows], R[rows], discount, NAMES)


class TestLinearSystem:
    @pytest.mark.parametrize(("slip", "step_reward", "discount"), [
        ("1/5", "-1/40", 1.0), ("1/5", "-1/25", 0.9), ("0", "-1/40", 1.0), ("1/2", "1/10", 1.0),
    ])  # fmt: skip
    def test_against_plain_sweeps(self, slip, step_reward, discount):
        directly = ["right" if cell == (2, 1) or cell[1] == 3 else "up" for cell in CELLS]
        world = GridWorld(float(Fraction(slip)), float(Fraction(step_reward)))
        policies = [[ACTIONS.index(action) for action in directly], POLICY]
        for policy in policies if world.slip_probability else policies[:1]:  # without a slip, (3,2) is never left
            V = linear_system(policy, world, discount)
            assert V[DECIDING] == pytest.approx(plain_values(policy, slip, step_reward, discount), abs=1e-12)
            assert (V[[CELLS.index(cell) for cell in PAID]] == 0).all()

    def test_a_policy_that_never_ends(self):
        left = [0] * 11
        with pytest.raises(ValueError, match=r"never ends from \(1,1\), \(2,1\), .*no finite value"):
            linear_system(left, GridWorld(slip_probability=0.0), 1.0)
        assert (linear_system(left, GridWorld(slip_probability=0.0, step_reward=0.0), 1.0) == 0).all()
        V = linear_system(left, GridWorld(slip_probability=0.0), 0.5)
        assert V[DECIDING] == pytest.approx(-0.025 / (1 - 0.5))


class TestAlgorithm:
    @pytest.mark.parametrize("settings", [
        {}, {"discount": 0.9, "learning_rate": 0.2, "learning_rate_exponent": 0.0}, {"max_episode_steps": 3},
        {"exploring_starts": False},
    ])  # fmt: skip
    def test_v_is_the_update_rule_on_the_transitions(self, settings):
        args = Args(episodes=300, seed=2, **settings)
        env = Transcript(TimeLimit(GridWorld(), args.max_episode_steps))
        *_, last = script.value_learning(env, np.array(POLICY), args)
        V, N = np.zeros(11), np.zeros(11, dtype=int)
        for s, a, r, s_next, terminated in env.transitions:
            assert a == POLICY[s]
            N[s] += 1
            future = 0.0 if terminated else V[s_next]
            V[s] += args.learning_rate / N[s] ** args.learning_rate_exponent * (r + args.discount * future - V[s])
        assert last.V == pytest.approx(V, abs=1e-12)
        assert (last.visits == N).all() and last.steps == len(env.transitions)

    def test_terminals_keep_value_0(self):
        last = learn(TimeLimit(GridWorld(), 1000), episodes=300)
        ends = [CELLS.index(cell) for cell in PAID]
        assert (last.V[ends] == 0).all() and (last.visits[ends] == 0).all()

    def test_a_time_limit_bootstraps(self):
        """For ever left along the wall at γ = 1/2 is worth -0.05 everywhere; cuts taken for ends leave -0.025."""
        env = TimeLimit(GridWorld(slip_probability=0.0), 1)
        last = learn(env, [0] * 11, episodes=2000, discount=0.5, learning_rate=0.5, learning_rate_exponent=0.0)
        assert last.V[DECIDING] == pytest.approx(-0.05, abs=1e-6)

    def test_starts(self):
        def first_cells(**settings):
            env = Transcript(TimeLimit(GridWorld(), 1))
            learn(env, episodes=900, **settings)
            return np.bincount([s for s, *_ in env.transitions], minlength=11)

        everywhere = first_cells()
        assert (everywhere[DECIDING] > 60).all() and everywhere.sum() == 900  # 100 each is expected
        assert first_cells(exploring_starts=False).tolist() == [900] + [0] * 10

    def test_same_seed_same_values(self):
        values = [learn(TimeLimit(GridWorld(), 1000), episodes=50, seed=seed).V for seed in (7, 7, 8)]
        assert (values[0] == values[1]).all() and (values[0] != values[2]).any()

    def test_starts_do_not_draw_the_slips_numbers(self):
        env = Transcript(TimeLimit(GridWorld(), 1))
        learn(env, episodes=20, seed=11)
        starts = [DECIDING.index(s) for s, *_ in env.transitions]
        for seed in (11, env.seeds[0]):
            assert starts != np.random.default_rng(seed).integers(len(DECIDING), size=20).tolist()

    @pytest.mark.parametrize("seed", [0, 1, 2])
    def test_converges_to_the_linear_system(self, seed):
        last = learn(TimeLimit(GridWorld(), 1000), episodes=20_000, seed=seed)
        assert np.abs(last.V[DECIDING] - plain_values(POLICY, "1/5", "-1/40", 1)).max() < 0.06


class TestCommandLine:
    def test_defaults(self, command_line, tmp_path):
        done = command_line("value_learning_gridworld.py", "--episodes", "2000")
        assert done.returncode == 0, done.stderr
        assert "Warning" not in done.stderr and "WARN" not in done.stderr
        (run,) = (tmp_path / "runs").iterdir()
        assert run.name.startswith("GridWorld__value_learning_gridworld__0__")
        result = json.loads((run / "values.json").read_text(encoding="utf-8"))
        assert result["policy"] == OPTIMAL
        exact = plain_values(POLICY, "1/5", "-1/40", 1)
        assert [result["exact_values"][NAMES[s]] for s in DECIDING] == pytest.approx(exact)
        rows = [line.split("|")[1:5] for line in done.stdout.splitlines() if line.count("|") == 5]
        arrows = dict(left="←", up="↑", right="→", down="↓")
        for name, action in OPTIMAL.items():
            x, y = int(name[1]), int(name[3])
            arrow, learnt, known = (row[x - 1].split() for row in rows[3 * (3 - y) :][:3])
            assert arrow == [arrows[action]]
            assert learnt == ["V", f"{result['values'][name]:.3f}"]
            assert known == ["V^π", f"{result['exact_values'][name]:.3f}"]
        error = max(abs(result["values"][name] - result["exact_values"][name]) for name in OPTIMAL)
        assert result["max_error"] == pytest.approx(error)
        curves = scalars(run)
        assert curves["evaluation/max_error"][-1] == (2000, pytest.approx(error))
        assert f"max |V - V^π| = {error:.4f} in the 9 cells" in done.stdout
        assert (run / "figure.png").read_bytes().startswith(b"\x89PNG")

    def test_cells_that_are_never_visited(self, monkeypatch, capsys, tmp_path):
        monkeypatch.chdir(tmp_path)
        flags = ("--no-exploring-starts", "--episodes", "500", "--output-json", "v.json", "--figure", "v.pdf")
        code, out, err = run_main(script, monkeypatch, capsys, *flags)
        assert code == 0, err
        result = json.loads((tmp_path / "v.json").read_text(encoding="utf-8"))
        unvisited = [name for name, value in result["values"].items() if value is None]
        assert "(4,1)" in unvisited and f"never visited: {', '.join(unvisited)}" in out
        assert "in the 8 cells" in out and (tmp_path / "v.pdf").is_file()

    def test_a_policy_of_ones_own(self, monkeypatch, capsys, tmp_path):
        monkeypatch.chdir(tmp_path)
        text = AS_FLAG.replace("3,2=left", "(3,2)=up")
        flags = ("--policy", text, "--episodes", "10", "--output-json", "v.json")
        code, *_ = run_main(script, monkeypatch, capsys, *flags)
        result = json.loads((tmp_path / "v.json").read_text(encoding="utf-8"))
        policy = [*POLICY]
        policy[CELLS.index((3, 2))] = ACTIONS.index("up")
        exact = plain_values(policy, "1/5", "-1/40", 1)
        assert code == 0 and [result["exact_values"][NAMES[s]] for s in DECIDING] == pytest.approx(exact)

    @pytest.mark.parametrize(("flags", "words"), [
        (["--episodes", "0"], ["episodes"]),
        (["--discount", "nan"], ["discount"]),
        (["--learning-rate", "2"], ["learning-rate"]),
        (["--learning-rate-exponent", "2"], ["learning-rate-exponent"]),
        (["--max-episode-steps", "0"], ["max-episode-steps"]),
        (["--seed", "-1"], ["seed"]),
        (["--slip-probability", "-0.1"], ["slip-probability"]),
        (["--step-reward", "inf"], ["step-reward"]),
        (["--step-reward", "0.1"], ["no policy is optimal"]),
        (["--step-reward", "0"], ["go round for ever", "--policy"]),
        (["--policy", "1,1=up"], ["no action for", "(3,2)", "(4,1)"]),
        (["--policy", "1,1=jump"], ["jump", "left, up, right, down"]),
        (["--policy", "2,2=up"], ["(2,2)"]),
        (["--policy", "4,3=up"], ["(4,3)"]),
        (["--policy", "9,9=up"], ["(9,9)"]),
        (["--policy", "1,1=up 1,1=up"], ["named twice"]),
        (["--policy", "up"], ["x,y=action"]),
        (["--policy", LEFT, "--slip-probability", "0"], ["never ends from", "(1,1)"]),
        (["--output-json", "missing/v.json"], ["missing"]),
        (["--figure", "v.gif"], [".png"]),
    ])  # fmt: skip
    def test_bad_input_is_one_line(self, flags, words, monkeypatch, capsys, tmp_path):
        monkeypatch.chdir(tmp_path)
        assert_refused(run_main(script, monkeypatch, capsys, *flags), tmp_path, *words)


def test_values_are_drawn_on_their_policy():
    axes, V = Figure().add_subplot(), np.linspace(-1, 1, 11)
    V[0] = np.nan
    script.draw_policy(axes, GridWorld(), V, np.eye(4, dtype=bool)[POLICY], "V")
    labels = sorted(text.get_text() for text in axes.texts if text.get_text())
    assert labels == sorted([*(script.number(V[s]) for s in DECIDING if s), "+1", "-1"])
