"""Value iteration: the lecture's two tables (§4.3), the error bound, discount 1, Gymnasium, models of arrays."""

import json
import re

import numpy as np
import policy_evaluation
import pytest
import value_iteration as script
from known_mdps import (
    BETTER_STAY,
    CANCELLING,
    ENDLESS_GAIN,
    FAIR_LOOP,
    FORBIDDEN,
    PURE_GAIN,
    SOLVERS,
    TO_AND_FRO,
    TRAP,
    best_values,
    random_model,
    run,
    solve,
    sparse_mdp,
    tables,
    written,
)

V_TABLE = """0 0 0 0 0
1 10 1 1 0
2 11 1 3.7 0
3 11 1 4 0
4 11 1 4 0
5 11 1 4 0"""
Q_TABLE = [  # the columns a1, a2 of s0 and a2 of s2; those of s1 and of a1 in s2 do not change
    ["1·[10 + 0] = 10", "0.6·[10 + 0] + 0.4·[5 + 0] = 8", "0.7·[1 + 0] + 0.3·[0 + 0] = 0.7"],
    ["1·[10 + 1] = 11", "0.6·[10 + 1] + 0.4·[5 + 1] = 9", "0.7·[1 + 0] + 0.3·[0 + 10] = 3.7"],
    ["1·[10 + 1] = 11", "0.6·[10 + 1] + 0.4·[5 + 3.7] = 10.08", "0.7·[1 + 0] + 0.3·[0 + 11] = 4"],
    ["1·[10 + 1] = 11", "0.6·[10 + 1] + 0.4·[5 + 4] = 10.2", "0.7·[1 + 0] + 0.3·[0 + 11] = 4"],
    ["1·[10 + 1] = 11", "0.6·[10 + 1] + 0.4·[5 + 4] = 10.2", "0.7·[1 + 0] + 0.3·[0 + 11] = 4"],
]
SLIPPERY_FROZEN_LAKE_UNDISCOUNTED = 14 / 17  # the probability of reaching the goal


def test_the_lectures_two_tables_as_printed(monkeypatch, capsys):
    code, out, err = run(script, monkeypatch, capsys)
    assert (code, err) == (0, "")
    V, Q, policy = tables(out)
    assert [" ".join(row) for row in V[1:]] == V_TABLE.splitlines()
    assert Q[0] == ["i", "Q_i(s0, a1)", "Q_i(s0, a2)", "Q_i(s1, a1)", "Q_i(s2, a1)", "Q_i(s2, a2)"]
    assert Q[1] == ["0"] * 6
    fixed = "1·[1 + 0] = 1"
    expected = [[str(i), a, b, fixed, fixed, c] for i, (a, b, c) in enumerate(Q_TABLE, start=1)]
    assert Q[2:] == expected
    assert policy[1:] == [["s0", "11", "a1"], ["s1", "1", "a1"], ["s2", "4", "a2"], ["sG", "0", "-"]]  # Equation 32


def test_the_lectures_two_tables_as_json(monkeypatch, capsys, tmp_path):
    run(script, monkeypatch, capsys, "--output-json", tmp_path / "out.json")
    result = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    V = [[entry["values"][state] for state in ("s0", "s1", "s2", "sG")] for entry in result["history"]]
    expected = [list(map(float, row.split()[1:])) for row in V_TABLE.splitlines()]
    np.testing.assert_allclose(V, expected, rtol=0, atol=1e-12)
    Q = [[q for choices in entry["action_values"].values() for q in choices.values()] for entry in result["history"]]
    expected = [[0] * 5, *([float(cell.split()[-1]) for cell in (a, b, "= 1", "= 1", c)] for a, b, c in Q_TABLE)]
    np.testing.assert_allclose(Q, expected, rtol=0, atol=1e-12)
    assert result["policy"] == {"s0": "a1", "s1": "a1", "s2": "a2"}
    assert result["iterations"] == 5 and result["residual"] == 0 and result["ties"] == {}
    assert set(result) == {"values", "action_values", "policy", "ties", "iterations", "residual", "history"}


def test_the_bound_holds_and_is_printed(monkeypatch, capsys):
    for seed in range(60):
        rng = np.random.default_rng(seed)
        model, discount = random_model(rng, proper=False), float(rng.choice([0, 0.3, 0.9]))
        mdp = script.mdp_from_json(model)
        V, *_ = script.value_iteration(mdp, discount, 1e-2, 100_000)
        bound = np.abs(script.maximum(mdp, script.backup(mdp, V, discount)) - V).max() / (1 - discount)
        error = max(abs(v - V[s]) for s, v in enumerate(best_values(model, discount).values()))
        assert error <= bound + 1e-12
    _, out, _ = run(script, monkeypatch, capsys, "--discount", 0.9)
    assert "max |V - V*| <= 0" in out and "0.6·[10 + 0.9·1] + 0.4·[5 + 0.9·1] = 8.9" in out
    _, out, _ = run(script, monkeypatch, capsys, "--env-id", "FrozenLake-v1", "--discount", 0.98, "--tolerance", 1e-4)
    residual, bound = re.search(r"Bellman residual (\S+)\nmax \|V - V\*\| <= (\S+)\n", out).groups()
    assert float(bound) == pytest.approx(50 * float(residual), rel=0.02) and float(bound) > 1e-4


def test_discount_0_counts_the_next_reward_alone():
    V, _, changes, _ = script.value_iteration(script.mdp_from_json(script.FIGURE_5), 0.0, 1e-12, 100)
    assert V.tolist() == [10, 1, 1, 0] and changes == [10, 0, 0]


def test_ragged_and_equal_action_sets_have_the_same_maximum():
    mdp = sparse_mdp(script, np.random.default_rng(0), 50)
    Q = np.random.default_rng(1).normal(size=200)
    assert mdp.width == 4 and script.mdp_from_json(script.FIGURE_5).width == 0
    np.testing.assert_array_equal(script.maximum(mdp, Q), Q.reshape(50, 4).max(axis=1))
    object.__setattr__(mdp, "width", 0)
    np.testing.assert_array_equal(script.maximum(mdp, Q), Q.reshape(50, 4).max(axis=1))


@pytest.mark.parametrize("module", SOLVERS, ids=lambda module: module.__name__)
class TestWithoutDiscount:
    def test_a_tie_with_walking_to_and_fro_still_arrives(self, module):
        mdp = module.mdp_from_json(TO_AND_FRO)
        solution = solve(module, mdp, 1.0)
        assert solution.V.tolist() == [1, 1, 0]
        assert mdp.actions[solution.policy[1]] == "out"

    def test_a_large_fine_makes_no_ties(self, module):
        mdp = module.mdp_from_json(FORBIDDEN)
        solution = solve(module, mdp, 1.0)
        assert solution.V[0] == pytest.approx(1.5) and mdp.actions[solution.policy[0]] == "a2"
        assert solution.tied[:4].tolist() == [False, True, False, False]

    def test_a_fair_bet_is_worth_nothing(self, module):
        mdp = module.mdp_from_json(FAIR_LOOP)
        solution = solve(module, mdp, 1.0)
        assert solution.V[0] == 0 and mdp.actions[solution.policy[0]] == "bet"

    def test_to_stay_for_nothing_is_better_than_to_pay(self, module):
        mdp = module.mdp_from_json(BETTER_STAY)
        solution = solve(module, mdp, 1.0)
        assert np.nan_to_num(solution.V).tolist() == [0, 0, 0]
        assert [mdp.actions[row] for row in solution.policy[:2]] == ["step", "back"]

    def test_infinite_values_end_in_one_line_that_names_the_states(self, module, monkeypatch, capsys, tmp_path):
        for model in (PURE_GAIN, ENDLESS_GAIN):
            flags = ["--mdp", written(tmp_path / "mdp.json", model), "--max-iterations", 2000]
            code, _, err = run(module, monkeypatch, capsys, *flags)
            assert code == 2 and err.count("\n") == 1 and err.startswith("error: ")
            assert re.search(r" in s\b", err) or module.__name__ == "linear_program", err
            assert "V* is infinite at discount 1" in err or (model, module) == (ENDLESS_GAIN, script)

    def test_a_state_without_a_finite_value_is_named(self, module, monkeypatch, capsys, tmp_path):
        model = {**TRAP, "start": "t"}
        code, out, err = run(module, monkeypatch, capsys, "--mdp", written(tmp_path / "mdp.json", model))
        assert code == 2 and out == "" and err.startswith("error: no policy has a finite value at discount 1")
        assert " in t:" in err or module.__name__ == "exhaustive_search"

    def test_gymnasium_models(self, module):
        if module.__name__ == "exhaustive_search":
            pytest.skip("4^11 policies and more")
        for env_id, kwargs, expected in [
            ("FrozenLake-v1", "", SLIPPERY_FROZEN_LAKE_UNDISCOUNTED),
            ("FrozenLake-v1", "is_slippery=false", 1),
            ("FrozenLake-v1", "map_name=8x8", 1),
            ("Taxi-v3", "", 7.93),
            ("CliffWalking-v1", "", -13),
        ]:
            mdp = module.mdp_from_gymnasium(env_id, kwargs)
            solution = solve(module, mdp, 1.0)
            assert mdp.start @ solution.V == pytest.approx(expected, abs=1e-8)
            # the policy attains its values: by an independent linear system over the states that it reaches
            model = policy_evaluation.mdp_from_gymnasium(env_id, kwargs)
            attained = policy_evaluation.policy_evaluation(model, solution.policy, 1.0, 1e-12, 100_000).V
            np.testing.assert_allclose(attained[~np.isnan(attained)], solution.V[~np.isnan(attained)], atol=1e-8)


def test_what_can_be_played_for_ever():
    transitions = {
        "a": {"on": [[1, "b", 0]]},  # b may end, and then a is not come back to
        "b": {"on": [[0.5, "a", 0], [0.5, "goal", 0]], "over": [[1, "c", 0]]},
        "c": {"stay": [[0.5, "c", 0], [0.5, "d", 0]]},
        "d": {"back": [[1, "c", 0]], "out": [[1, "goal", 0]]},
    }
    mdp = script.mdp_from_json({"start": "a", "terminal": ["goal"], "transitions": transitions})
    assert script.lasting_rows(mdp, np.arange(6)).tolist() == [3, 4]
    assert script.lasting_rows(mdp, np.array([0, 1, 3, 5])).tolist() == []


def test_rewards_that_cancel_in_a_loop_are_not_answered():
    mdp = script.mdp_from_json(CANCELLING)
    with pytest.raises(ValueError, match=r"not converged after --max-iterations 50 .* in s, t"):
        script.value_iteration(mdp, 1.0, 1e-12, 50)
    # lazily gone through, V converges to what no policy attains
    lazy = {"s": {"step": [[0.5, "s", -1], [0.5, "t", -1]], "out": [[1, "goal", -10]]},
            "t": {"back": [[0.5, "s", 1], [0.5, "t", 1]], "out": [[1, "goal", -10]]}}  # fmt: skip
    mdp = script.mdp_from_json({**CANCELLING, "transitions": lazy})
    _, Q, _, _ = script.value_iteration(mdp, 1.0, 1e-12, 1000)
    with pytest.raises(ValueError, match="no policy attains the values found in s, t"):
        script.greedy_policy(mdp, Q, script.tied_rows(mdp, Q, 1e-12), 1.0)


def test_max_iterations_is_an_error_and_nothing_is_written(monkeypatch, capsys, tmp_path):
    code, out, err = run(script, monkeypatch, capsys, "--max-iterations", 4, "--output-json", tmp_path / "out.json")
    assert (code, out) == (2, "") and "has not converged after --max-iterations 4" in err
    assert list(tmp_path.iterdir()) == []
    assert run(script, monkeypatch, capsys, "--max-iterations", 5)[0] == 0


def test_gymnasium_at_both_discounts_on_the_command_line(monkeypatch, capsys, tmp_path):
    for env_id, discount, start in [("Taxi-v3", 1, "= 7.93\n"), ("CliffWalking-v1", 0.99, "V(36) = -12.247"),
                                    ("FrozenLake-v1", 0.99, "V(0) = 0.54202593")]:  # fmt: skip
        flags = ["--env-id", env_id, "--discount", discount, "--figure", tmp_path / f"{env_id}.png"]
        code, out, err = run(script, monkeypatch, capsys, *flags)
        assert (code, err) == (0, "") and start in out
        assert (tmp_path / f"{env_id}.png").stat().st_size > 10_000


def test_the_grid_figure_has_an_arrow_where_the_agent_acts_and_only_there(monkeypatch):
    mdp = script.mdp_from_gymnasium("FrozenLake-v1", "is_slippery=false")
    solution = solve(script, mdp, 1.0)
    axes = script.Figure().subplots()
    arrows = {}
    monkeypatch.setattr(axes, "quiver", lambda x, y, dx, dy, **_: arrows.update({(round(x), round(y)): (dx, dy)}))
    script.draw_grid(axes, mdp, solution)
    holes_and_goal = {(1, 1), (3, 1), (3, 2), (0, 3), (3, 3)}
    assert set(arrows) == {(x, y) for y in range(4) for x in range(4)} - holes_and_goal
    assert np.round(arrows[2, 3]).tolist() == [1, 0]  # right, to the goal


def test_a_large_model_of_arrays_alone():
    mdp = sparse_mdp(script, np.random.default_rng(3), 20_000)
    V, _, changes, history = script.value_iteration(mdp, 0.9, 1e-9, 1000)
    np.testing.assert_allclose(V, (mdp.R + 0.9 * (mdp.P @ V)).reshape(-1, 4).max(axis=1), atol=1e-8)
    assert changes[-1] <= 1e-9 and history == []
    assert script.names(mdp, np.array([7, 3])) == "3, 7"


@pytest.mark.parametrize("spoil, message", [
    (lambda arrays: arrays["P"].data.__setitem__(0, 0.9), r"state 0, action 0: the probabilities sum to"),
    (lambda arrays: arrays["P"].data.__setitem__(0, np.nan), r"above 0"),
    (lambda arrays: arrays["P"].data.__setitem__(0, -0.1), r"above 0"),
    (lambda arrays: arrays["R"].__setitem__(3, np.inf), r"finite"),
    (lambda arrays: arrays["terminal"].__setitem__(2, True), r"state 2, action 0: the probabilities sum to 1"),
    (lambda arrays: arrays["first_row"].__setitem__(1, 0), r"first_row"),
    (lambda arrays: arrays["start"].__setitem__(1, 1), r"start"),
])  # fmt: skip
def test_arrays_that_are_no_mdp(spoil, message):
    mdp = sparse_mdp(script, np.random.default_rng(0), 10)
    arrays = {name: getattr(mdp, name) for name in ("states", "actions", "first_row", "P", "R", "start", "terminal")}
    spoil(arrays)
    with pytest.raises(ValueError, match=message):
        script.MDP(**arrays)
