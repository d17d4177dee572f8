"""value_iteration.py: the two tables of §4.3, the figure; and the four solvers side by side."""

import gymnasium as gym
import numpy as np
import pytest
import value_iteration as script
from known_mdps import SCRIPTS, SOLVERS, brute, dense, go, q_row, random_model, refused, run, tables

N, OUT, TO_S, TO_T = None, [go("goal", -9)], [go("s")], [go("t")]
TRAPS = {  # at discount 1: V(s) of the four SOLVERS, N where one refuses
    "fro": ([1, 1, 1, 1], {"s": {"on": TO_T, "best": [go("goal", 1)]}, "t": {"": TO_S}}),
    "cost": ([N, N, N, N], {"s": {"stay": [go("s", -1)]}}),
    "gain": ([N, N, N, N], {"s": {"out": OUT, "stay": [go("s", 1)]}}),
    "gain of 2": ([N, N, N, N], {"s": {"out": OUT, "on": [go("t", 2)]}, "t": {"": [go("s", -1)]}}),
    "0 of 2": ([N, N, -9, -9], {"s": {"on": [go("t", -1)], "best": OUT}, "t": {"": [go("s", 1)]}}),
    "0 at rest": ([N, N, -9, -9], {"s": {"on": [go("s", -1, 0.5), go("t", -1, 0.5)], "best": OUT},
                                   "t": {"on": [go("s", 1, 0.5), go("t", 1, 0.5)]}}),
    "0 of 3": ([N, 0, 0, 0], {"s": {"on": [go("u")], "best": [go("goal")]},
                              "t": {"back": [go("s", 1)]}, "u": {"on": [go("t", -1)]}}),
    "held up": ([0, N, 0, 0], {"s": {"best": [go("s", 0, 0.7), go("s", 0, 0.2), go("s", 0, 0.1)],
                                     "on": [go("t", 8)]}, "t": {"out": OUT}}),  # .7 + .2 + .1 < 1
    "to stay is best": ([0, 0, 0, 0], {"s": {"out": OUT, "best": TO_T}, "t": {"back": TO_S}}),
    "a bet": ([0, 0, 0, 0], {"s": {"out": OUT, "best": [go("s", 3, 0.4), go("s", -2, 0.6)]}}),
    "rest": ([N, -1, -1, -1], {"s": {"x": [go("s", -1)], "best": [go("t", -1)]}, "t": {"": TO_T}}),
    "a fine": ([1.5, 1.5, 1.5, 1.5], {"s": {"a": [go("goal", 1)], "best": [go("goal", 1.5)],
                                            "c": TO_T}, "t": {"out": [go("goal", -1e9)]}}),
    "slow beside a fine": ([1, 1, 1, 1], {"r": {"": [go("s", 0, 0.5), go("t", 0, 0.5)]},
        "s": {"best": [go("s", 0, 0.99), go("goal", 1, 0.01)]}, "t": {"": [go("goal", -1e10)]}}),
}  # fmt: skip


def test_the_lectures_two_tables(tmp_path, capsys):
    result = run(script, tmp_path)
    V, Q = tables(capsys.readouterr().out)
    assert V == [["0", "0", "0"], ["10", "1", "1"], ["11", "1", "3.7"], *3 * [["11", "1", "4"]]]
    assert Q[1:3] == [q_row(0, 10, 0, 0, 8, 0, 0.7), q_row(1, 11, 1, 1, 9, 10, 3.7)]
    assert Q[3:] == [q_row(1, 11, 1, 3.7, 10.08, 11, 4), *2 * [q_row(1, 11, 1, 4, 10.2, 11, 4)]]
    assert result["policy"] == {"s0": "a1", "s1": "a1", "s2": "a2"} and result["iterations"] == 4
    assert result["values"] == pytest.approx({"s0": 11, "s1": 1, "s2": 4})
    refused(script, tmp_path, max_iterations=3)
    half = {"discount": 0.5, "tolerance": 0.2}  # V: 1, 1.5, 1.75, and one more sweep gives 1.875
    assert run(script, tmp_path, {"s": {"a": [go("s", 1)]}}, **half)["residual"] == 0.125


@pytest.mark.parametrize("name", TRAPS)
@pytest.mark.parametrize("solver", range(4), ids=SOLVERS)
def test_traps(solver, name, tmp_path):
    value, model = TRAPS[name][0][solver], TRAPS[name][1]
    limit = {"max_iterations": 4000} if solver < 3 else {}  # the linear program has none
    if value is None:
        refused(SCRIPTS[solver + 1], tmp_path, model, **limit)
    else:
        found = run(SCRIPTS[solver + 1], tmp_path, model, **limit)
        assert found["values"]["s"] == pytest.approx(value, abs=1e-8)
        assert found["policy"]["s"] == "best" or "best" not in model["s"]


@pytest.mark.parametrize("discount", [0, 0.5, 0.95, 1])
@pytest.mark.parametrize("solver", SCRIPTS[1:], ids=SOLVERS)
def test_random_models_against_every_policy(solver, discount, tmp_path):
    for seed in (*range(50), 1558, 2960):  # the last two are hard for a linear program
        model = random_model(np.random.default_rng(seed), proper=discount == 1)
        found, best = run(solver, tmp_path, model, discount=discount), brute(model, discount)
        V, policy = found["values"], {s: next(iter(model[s])) for s in model} | found["policy"]
        seen = 1 if solver is SCRIPTS[1] else len(model)  # exhaustive search: the start alone
        atol = 1e-6 if "-1000000000.0" in str(model) else 1e-8  # beside a fine of 1e9
        for values in (list(V.values()), dense(model, policy, discount)):
            np.testing.assert_allclose(values[:seen], best[:seen], 1e-8, atol)
        for s, a in found["policy"].items():
            Q = sum(p * (r + discount * (0 if end else V[n])) for p, n, r, end in model[s][a] if p)
            assert found["action_values"][s][a] == pytest.approx(Q, rel=1e-8, abs=atol)
        assert found["residual"] <= 1e-8 * max(1, abs(best).max())


@pytest.mark.parametrize(("env_id", "kwargs", "discount", "start", "value"), [
    ("FrozenLake-v1", {}, 1, "0", 14 / 17), ("FrozenLake-v1", {}, 0.99, "0", 0.54202593),
    ("FrozenLake-v1", {"map_name": "8x8"}, 1, "0", 1), ("CliffWalking-v1", {}, 1, "36", -13),
    ("FrozenLake-v1", {"map_name": "8x8"}, 0.99, "0", 0.41464), ("Taxi-v4", {}, 1, "0", 19),
    ("FrozenLake-v1", {"is_slippery": False}, 1, "0", 1), ("Taxi-v4", {}, 0.9, "0", 17)])
def test_gymnasium(env_id, kwargs, discount, start, value, tmp_path):  # fmt: skip
    """The solvers agree; each policy, played, ends and gets what V says (± 4 standard errors)."""
    model = {"env_id": env_id, "env_kwargs": " ".join(f"{k}={v}" for k, v in kwargs.items())}
    found = [run(solver, tmp_path, **model, discount=discount) for solver in SCRIPTS[2:]]
    env, V, gaps = gym.make(env_id, **kwargs).unwrapped, found[0]["values"], []
    assert V[start] == pytest.approx(value, abs=1e-5)
    for result in found:
        assert result["values"] == pytest.approx(V, abs=1e-6)
        for episode in range(300):
            s, _ = env.reset(seed=episode)
            steps, ended, gain = 0, False, -V[str(s)]
            while not ended:
                s, r, ended, _, _ = env.step(int(result["policy"][str(s)]))
                steps, gain = steps + 1, gain + r * discount**steps
                assert steps < 3000
            gaps.append(gain)
        assert abs(np.mean(gaps)) <= 4 * np.std(gaps) / len(gaps) ** 0.5 + 1e-6


@pytest.mark.parametrize("slip", [False, True])
@pytest.mark.parametrize(("env_id", "fields", "ways"), [
    ("FrozenLake-v1", ["....", ". . ", "... ", " .. "], [(-1, 0), (0, -1), (1, 0), (0, 1)]),
    ("CliffWalking-v1", [*3 * [12 * "."], "." + 11 * " "], [(0, 1), (1, 0), (0, -1), (-1, 0)])])
def test_the_figure(env_id, fields, ways, slip, tmp_path, monkeypatch):  # fmt: skip
    """An arrow wherever the agent acts, the way of its action: right and up."""
    drawn, settings = [], {"env_id": env_id, "env_kwargs": f"is_slippery={slip}", "discount": 0.99}
    monkeypatch.setattr("matplotlib.axes.Axes.quiver", lambda _, *uv, **style: drawn.extend(uv))
    policy = run(script, tmp_path, **settings, figure=tmp_path / "figure.png")["policy"]
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    for s, field in enumerate("".join(fields)):
        arrow = tuple(way.flat[s] for way in drawn)
        assert arrow == ways[int(policy[str(s)])] if field == "." else np.isnan(arrow).any()


def test_large_models_of_arrays_alone(monkeypatch):
    rng, S = np.random.default_rng(0), 20_000
    p, s_next = rng.dirichlet(np.ones(5), 4 * S) * (1 + 5e-10), rng.integers(0, S, (4 * S, 5))
    p[::2] *= 0.8  # of every second state each action ends with 0.2, of the others none does
    P = script.sparse.csr_array((p.ravel(), (np.repeat(np.arange(4 * S), 5), s_next.ravel())))
    R = rng.random((4, S))
    V, _ = script.value_iteration(P, R, 1)
    policy = script.proper_policy(P, R, script.backup(P, R, V, 1))
    expected = R + (p * V[s_next]).sum(axis=1).reshape(4, S)
    assert abs(expected.max(axis=0) - V).max() < 1e-9
    assert (policy == expected.argmax(axis=0)).all()
    monkeypatch.setattr(SCRIPTS[3].linalg, "spsolve", None)  # whose factors would fill in
    assert abs(SCRIPTS[3].policy_iteration(P, R, 0 * policy, 1, 12)[-1][1] - V).max() < 1e-9
