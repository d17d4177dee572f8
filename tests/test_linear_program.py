"""The linear program of Equation 27: program, duals, certificate."""

import json

import linear_program as script
import numpy as np
import pytest
from known_mdps import CANCELLING, best_values, random_model, run, tables, written


def test_the_lectures_mdp(monkeypatch, capsys, tmp_path):
    files = ["--output-json", tmp_path / "out.json", "--figure", tmp_path / "figure.png"]
    code, out, err = run(script, monkeypatch, capsys, *files)
    assert (code, err) == (0, "")
    assert "minimise   V(s0) + V(s1) + V(s2) + V(sG)" in out
    assert tables(out)[0][1:] == [
        ["V(s0)", "≥", "1·[10 + V(s1)]", "a1", "11", "yes", "1.3"],
        ["V(s0)", "≥", "0.6·[10 + V(s1)] + 0.4·[5 + V(s2)]", "a2", "10.2", "0"],
        ["V(s1)", "≥", "1·[1 + V(sG)]", "a1", "1", "yes", "2.3"],
        ["V(s2)", "≥", "1·[1 + V(sG)]", "a1", "1", "0"],
        ["V(s2)", "≥", "0.7·[1 + V(sG)] + 0.3·[0 + V(s0)]", "a2", "4", "yes", "1"],
        ["V(sG)", "=", "0"],
    ]
    assert "Σ V = 16; dual Σ visits·R = 16" in out and "value iteration" in out and " ms" in out
    result = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert result["values"] == pytest.approx({"s0": 11, "s1": 1, "s2": 4, "sG": 0}, abs=1e-12)
    assert result["policy"] == {"s0": "a1", "s1": "a1", "s2": "a2"} and result["history"] == []
    # who starts once in each state comes to s0 once and from s2 with probability 0.3, and to s1 once and from s0
    assert result["visits"]["s0"] == pytest.approx({"a1": 1.3, "a2": 0}, abs=1e-12)
    assert result["visits"]["s1"]["a1"] == pytest.approx(2.3, abs=1e-12)
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_the_dual_is_the_expected_visits():
    for seed in range(100):
        rng = np.random.default_rng(seed)
        proper = seed % 2 == 0
        model, discount = random_model(rng, proper), 1.0 if proper else 0.9
        mdp = script.mdp_from_json(model)
        solution, visits = script.linear_program(mdp, discount, 1e-12, 10_000)
        best = best_values(model, discount)
        np.testing.assert_allclose(solution.V[: len(best)], list(best.values()), atol=1e-8)
        assert visits @ mdp.R == pytest.approx(solution.V.sum(), abs=1e-7)  # strong duality
        # visits to s: one start, and those that lead here
        here = np.bincount(mdp.state_of_row, visits)
        arrivals = 1 + discount * (mdp.P.T @ visits)
        np.testing.assert_allclose(here[~mdp.terminal], arrivals[~mdp.terminal], atol=1e-7)
        assert (visits >= -1e-9).all()
        # only constraints that hold with equality are visited
        assert not visits[~solution.tied].any()


def test_outcomes_that_meet_in_a_state_are_added_up():
    outcomes = [[0.25, "s", 1], [0.25, "s", 2], [0.5, "g", 0]]
    model = {"start": "s", "terminal": ["g"], "transitions": {"s": {"a": outcomes}}}
    solution, visits = script.linear_program(script.mdp_from_json(model), 1.0, 1e-12, 1000)
    assert solution.V[0] == pytest.approx(1.5, abs=1e-12) and visits[0] == pytest.approx(2, abs=1e-12)


def test_actions_that_differ_little_are_told_apart():
    rng = np.random.default_rng(0)
    for _ in range(30):
        transitions = {}
        for s in range(5):
            base = list(zip((0.25, 0.25, 0.5), map(str, rng.integers(0, 5, 3)), (1, 1, 0), strict=True))
            transitions[str(s)] = {a: [[p, s_next, r + 5e-8 * rng.random()] for p, s_next, r in base] for a in "abc"}
        mdp = script.mdp_from_json({"start": "0", "transitions": transitions})
        solution, _ = script.linear_program(mdp, 0.95, 1e-12, 1000)
        best = best_values({"transitions": transitions}, 0.95)
        np.testing.assert_allclose(solution.V, list(best.values()), rtol=0, atol=1e-9)


def test_the_best_policy_with_a_value_where_rewards_cancel():
    assert script.linear_program(script.mdp_from_json(CANCELLING), 1.0, 1e-12, 1000)[0].V.tolist() == [-10, -9, 0]


def test_max_iterations_is_an_error(monkeypatch, capsys):
    code, _, err = run(script, monkeypatch, capsys, "--env-id", "FrozenLake-v1", "--max-iterations", 3)
    assert code == 2 and "HiGHS stopped without a solution (--max-iterations 3)" in err and err.count("\n") == 1


def test_a_comparison_that_does_not_converge_costs_no_solution(monkeypatch, capsys, tmp_path):
    flags = ["--mdp", written(tmp_path / "mdp.json", CANCELLING), "--figure", tmp_path / "figure.png"]
    code, out, err = run(script, monkeypatch, capsys, *flags, "--output-json", tmp_path / "out.json")
    assert (code, err) == (0, "") and "V has not converged after --max-iterations 100,000" in out
    assert json.loads((tmp_path / "out.json").read_text())["values"] == {"s": -10, "t": -9, "goal": 0}
